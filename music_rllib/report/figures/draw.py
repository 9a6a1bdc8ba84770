"""Drawing of figures: SVG elements for the page, and files for one and two columns of a paper.

A figure has its own canvas and does not use pyplot, so that no display is needed. On the page each
panel is an SVG element, so that a narrow window stacks them, and its colours are those of the page,
so that it follows light and dark. The files have all panels together and embed their fonts.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, TypeVar

import joblib
import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.fonts import short_font
from music_rllib.report.figures.plots import PANEL, Legend, Panel, legend_handles

_Drawn = TypeVar("_Drawn")

TEXT_WIDTH, COLUMN_WIDTH = 7.16, 3.5
"""Width in inches of a paper's text and of one of its two columns."""
COLUMN = "-column"
"""Suffix to the name of a figure that is one column wide."""
ENDINGS = (".png", ".svg", ".pdf")
_PAGE_FONT, _PAPER_FONT = 10.0, 8.0
_PANELS_IN_A_ROW = 3
_LEFT, _RIGHT, _BOTTOM = 0.84, 0.2, 0.52
"""A panel's margins in inches for text of 10 points."""
_HANDLE, _LETTER, _LINE = 0.6, 0.085, 0.2
"""Inches in a legend: in front of a label, per letter, and from line to line."""

# Matplotlib draws with the first colours, and the page's own colours then replace them in the SVG.
_STAND_INS = ("#010203", "#040506", "#070809")
_OF_THE_PAGE = ("currentColor", "var(--grid)", "var(--paper)")
_ON_PAPER = ("#1a1a1a", "#d9d9d9", "#ffffff")
_FONT = ("DejaVu Sans", "Verdana", "sans-serif")
_CONDITION = re.compile(r'<g id="condition-(\d+)-([^"]*)">')


class Figures:
    """Drawings as SVG elements for the page and as files.

    With processes a drawing is drawn as soon as it is added, without them when it is read.
    """

    def __init__(self, processes: Executor | None = None) -> None:
        self.drawings: list[Drawing] = []
        self._processes = processes
        self._inline: list[Callable[[], tuple[str, ...]]] = []
        self._files: list[Callable[[], dict[str, bytes]]] = []

    def add(self, drawing: Drawing) -> None:
        """Add a drawing to be drawn, under a name of its own."""
        while any(drawing.name == other.name for other in self.drawings):
            drawing = replace(drawing, number=drawing.number + 1)
        self.drawings.append(drawing)
        self._inline.append(self._started(_inline, drawing))
        self._files.append(self._started(_files, drawing))

    @cached_property
    def pictures(self) -> dict[str, tuple[str, ...]]:
        """The SVG elements of each drawing's panels by the drawing's name."""
        pairs = zip(self.drawings, self._inline, strict=True)
        return {drawing.name: result() for drawing, result in pairs}

    def files(self) -> Iterator[tuple[str, dict[str, bytes]]]:
        """Each drawing's name and its files; see :func:`files`."""
        for drawing, result in zip(self.drawings, self._files, strict=True):
            yield drawing.name, result()

    def _started(self, draw: Callable[[Drawing], _Drawn], drawing: Drawing) -> Callable[[], _Drawn]:
        """A function that returns `draw(drawing)`, drawn in a process where there are some."""
        here = partial(draw, drawing)
        if self._processes is None:
            return here
        # Panels are closures, which pickle does not support.
        picklable = joblib.wrap_non_picklable_objects(drawing, keep_wrapper=False)
        try:
            future = self._processes.submit(draw, picklable)
        except BrokenExecutor:  # a process was killed, for example for its memory
            return here
        return lambda: here() if isinstance(future.exception(), BrokenExecutor) else future.result()


def _inline(drawing: Drawing) -> tuple[str, ...]:
    return tuple(
        _svg_inline(panel, f"{drawing.name}-{number}")
        for number, panel in enumerate(drawing.panels)
    )


def _files(drawing: Drawing) -> dict[str, bytes]:
    return files(drawing.panels, drawing.legend)


def _svg_inline(panel: Panel, name: str) -> str:
    """A panel as an SVG element for the page; ids begin with `name` to be unique in the page.

    The marks of a condition carry its number, and its label as a title, which browsers show.
    Matplotlib escapes all texts.
    """
    with mpl.rc_context(_settings(_PAGE_FONT, _STAND_INS)):
        figure = drawn_figure([panel], [], PANEL[0], _PAGE_FONT)
        figure.patch.set_alpha(0.0)
        text = _svg(figure)
    text = _CONDITION.sub(r'<g data-condition="\1"><title>\2</title>', text[text.index("<svg") :])
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, colour in zip(_STAND_INS, _OF_THE_PAGE, strict=True):
        text = text.replace(stand_in, colour)
    size = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', text)
    assert size is not None, "matplotlib gives an SVG a size in points"
    text = text.replace(size[0], "")
    return re.sub(r">\s+<", "><", text)


def files(panels: Sequence[Panel], legend: Legend) -> dict[str, bytes]:
    """All panels on white paper with a legend, by the suffix to the figure's name.

    `.svg`, `.pdf` and `.png` (150 dpi) are as wide as a paper's text, `-column.svg` and
    `-column.pdf` as one of its two columns.
    """
    contents = {}
    outlines = {"svg.fonttype": "path", "pdf.fonttype": 42}
    fonts = {"font.family": [short_font(), "sans-serif"]}
    with mpl.rc_context(_settings(_PAPER_FONT, _ON_PAPER) | outlines | fonts):
        for width, name, kinds in (
            (TEXT_WIDTH, "", ("svg", "pdf", "png")),
            (COLUMN_WIDTH, COLUMN, ("svg", "pdf")),
        ):
            figure = drawn_figure(panels, legend, width, _PAPER_FONT)
            for kind in kinds:
                contents[f"{name}.{kind}"] = _saved(figure, kind)
    return contents


def _saved(figure: Figure, kind: str) -> bytes:
    if kind == "svg":
        return _CONDITION.sub("<g>", _svg(figure)).encode()
    buffer = io.BytesIO()
    metadata = {"CreationDate": None} if kind == "pdf" else {}
    figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _settings(font: float, colours: tuple[str, str, str]) -> Any:
    """Matplotlib's settings for text of `font` points and the colours of ink, grid and paper."""
    ink, grid, paper = colours
    inked = ("axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "text.color")
    return {
        **dict.fromkeys((*inked, "xtick.color", "ytick.color"), ink),
        "grid.color": grid,
        "axes.facecolor": paper,
        "figure.facecolor": paper,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.family": "sans-serif",
        "font.sans-serif": list(_FONT),
        "font.size": font,
        "axes.labelsize": "medium",
        "xtick.labelsize": 0.9 * font,
        "ytick.labelsize": 0.9 * font,
        "svg.fonttype": "none",
        # The name of a task may be no valid formula, like $x_{1$.
        "text.parse_math": False,
        # Ids in an SVG do not depend on the time, so that the same figure is the same file.
        "svg.hashsalt": "music_rllib",
    }


def drawn_figure(panels: Sequence[Panel], legend: Legend, width: float, font: float) -> Figure:
    """A figure with the panels in rows and the legend below them.

    Margins are fixed: matplotlib's own layout takes longer than everything else together.
    """
    scale = font / _PAGE_FONT
    in_a_row = min(len(panels), _PANELS_IN_A_ROW) if width > 1.5 * COLUMN_WIDTH else 1
    rows = [panels[i : i + in_a_row] for i in range(0, len(panels), in_a_row)]
    heights = [max(panel.height for panel in row) * scale for row in rows]
    entries, columns, lines = _legend_grid(legend, width, scale)
    below = (_LINE * lines + 0.1) * scale if entries else 0.0
    top = sum(heights) + below
    figure = Figure(figsize=(width, top))
    FigureCanvasAgg(figure)
    for row, height in zip(rows, heights, strict=True):
        for number, panel in enumerate(row):
            cell = (number * width / in_a_row, top - height, width / in_a_row, height)
            _draw_panel(figure, panel, cell, scale)
        top -= height
    if entries:
        handles = legend_handles(entries)
        figure.legend(handles=handles, loc="lower center", ncols=columns, frameon=False)
    return figure


def _draw_panel(
    figure: Figure, panel: Panel, cell: tuple[float, float, float, float], scale: float
) -> None:
    """Draw a panel into its cell: left, bottom, width and height in inches."""
    left, bottom, width, height = cell
    whole_width, whole_height = map(float, figure.get_size_inches())
    x, y = left + _LEFT * scale, bottom + _BOTTOM * scale
    across, up = width - (_LEFT + _RIGHT) * scale, height - (_BOTTOM + panel.top) * scale
    axes = figure.add_axes(
        (x / whole_width, y / whole_height, across / whole_width, up / whole_height)
    )
    axes.patch.set_alpha(0.0)
    centre = (x + across / 2) / whole_width
    title_top = (bottom + height - 0.07 * scale) / whole_height
    figure.text(centre, title_top, panel.title, ha="center", va="top", size="large")
    panel.draw(axes)


def _legend_grid(legend: Legend, width: float, scale: float) -> tuple[Legend, int, int]:
    """Labels broken to fit into the figure, and the numbers of columns and of lines of text."""
    letter, handle = _LETTER * scale, _HANDLE * scale
    most = max(12, int((width - handle - 0.2) / letter))
    entries = [(textwrap.fill(label, most), style) for label, style in legend]
    longest = max((len(line) for label, _ in entries for line in label.split("\n")), default=0)
    columns = max(1, int(width / (handle + letter * longest)))
    rows = math.ceil(len(entries) / columns)
    by_row = (entries[row::rows] for row in range(rows))
    return entries, columns, sum(max(label.count("\n") + 1 for label, _ in row) for row in by_row)
