"""Every figure drawn: for the page, and as files for one and two columns of a paper.

Every figure is drawn on its own canvas, never through pyplot, so no display is needed. On the page
each panel is an SVG of its own, so that a narrow window stacks them, and takes its ink from the
page, so that it follows light and dark. The files have all panels together, their fonts embedded.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from functools import cached_property, partial
from typing import Any, TypeVar

import joblib
import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.fonts import short_font
from music_rllib.report.figures.plots import PANEL, Legend, Panel

__all__ = ["Figures", "drawn_figure", "files", "stale_files"]

_Drawn = TypeVar("_Drawn")

TEXT_WIDTH, COLUMN_WIDTH = 7.16, 3.5
"""Inches of a paper's two columns and of one."""
COLUMN = "-column"
"""Behind the name of a figure that is one column wide."""
ENDINGS = (".png", ".svg", ".pdf")
_PAGE_FONT, _PAPER_FONT = 10.0, 8.0
_PANELS_IN_A_ROW = 3
_LEFT, _RIGHT, _BOTTOM = 0.84, 0.2, 0.52
"""A panel's margins in inches, where its text has 10 points."""
_HANDLE, _LETTER, _LINE = 0.6, 0.085, 0.2
"""Inches in a legend: before a label, of a letter, and from line to line."""

# Stand for "the page's own colour" in an SVG, and are replaced by it.
_STAND_INS = ("#010203", "#040506", "#070809")
_OF_THE_PAGE = ("currentColor", "var(--grid)", "var(--paper)")
_ON_PAPER = ("#1a1a1a", "#d9d9d9", "#ffffff")
_FONT = ("DejaVu Sans", "Verdana", "sans-serif")
_CONDITION = re.compile(r'<g id="condition-(\d+)-([^"]*)">')


class Figures:
    """Drawings, as SVG elements for the page and as files.

    With processes each is drawn from when it is added, without when it is asked for.
    """

    def __init__(self, processes: Executor | None = None) -> None:
        self.drawings: list[Drawing] = []
        self._processes = processes
        self._inline: list[Callable[[], tuple[str, ...]]] = []
        self._files: list[Callable[[], dict[str, bytes]]] = []

    def add(self, drawing: Drawing) -> None:
        """Draw it, now or later."""
        self.drawings.append(drawing)
        self._inline.append(self._begun(_inline, drawing))
        self._files.append(self._begun(_files, drawing))

    @cached_property
    def pictures(self) -> dict[str, tuple[str, ...]]:
        """An SVG element for each panel, by the drawings' names."""
        return {one.name: made() for one, made in zip(self.drawings, self._inline, strict=True)}

    def files(self) -> Iterator[tuple[str, dict[str, bytes]]]:
        """Each drawing's name and its files; see :func:`files`."""
        for one, made in zip(self.drawings, self._files, strict=True):
            yield one.name, made()

    def _begun(self, draw: Callable[[Drawing], _Drawn], drawing: Drawing) -> Callable[[], _Drawn]:
        if self._processes is None:
            return partial(draw, drawing)
        # Panels are closures, which Python's own pickle does not take.
        sent = joblib.wrap_non_picklable_objects(drawing, keep_wrapper=False)
        here = partial(draw, drawing)
        try:
            begun = self._processes.submit(draw, sent)
        except BrokenExecutor:  # a process was killed, by want of memory, say
            return here
        return lambda: here() if isinstance(begun.exception(), BrokenExecutor) else begun.result()


def _inline(drawing: Drawing) -> tuple[str, ...]:
    return tuple(
        _svg_inline(panel, f"{drawing.name}-{number}")
        for number, panel in enumerate(drawing.panels)
    )


def _files(drawing: Drawing) -> dict[str, bytes]:
    return files(drawing.panels, drawing.legend)


def _svg_inline(panel: Panel, name: str) -> str:
    """A panel as an SVG element for the page; ids begin with `name`, to be the page's only ones.

    What belongs to a condition carries its number, and its value as a title, which browsers show.
    Matplotlib escapes the texts in it.
    """
    with mpl.rc_context(_settings(_PAGE_FONT, _STAND_INS)):
        drawn = drawn_figure([panel], [], PANEL[0], _PAGE_FONT)
        drawn.patch.set_alpha(0.0)
        text = _svg(drawn)
    text = _CONDITION.sub(r'<g data-condition="\1"><title>\2</title>', text[text.index("<svg") :])
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stands_for, colour in zip(_STAND_INS, _OF_THE_PAGE, strict=True):
        text = text.replace(stands_for, colour)
    size = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', text)
    assert size is not None, "matplotlib gives an SVG a size in points"
    text = text.replace(size[0], "")
    return re.sub(r">\s+<", "><", text)


def files(panels: Sequence[Panel], legend: Legend) -> dict[str, bytes]:
    """All panels on white paper, with a legend, by what follows the figure's name.

    `.svg`, `.pdf` and `.png` (150 dpi) are as wide as a paper's text, `-column.svg` and
    `-column.pdf` as one of its two columns.
    """
    made = {}
    outlines = {"svg.fonttype": "path", "pdf.fonttype": 42}
    fonts = {"font.family": [short_font(), "sans-serif"]}
    with mpl.rc_context(_settings(_PAPER_FONT, _ON_PAPER) | outlines | fonts):
        for width, name, kinds in (
            (TEXT_WIDTH, "", ("svg", "pdf", "png")),
            (COLUMN_WIDTH, COLUMN, ("svg", "pdf")),
        ):
            drawn = drawn_figure(panels, legend, width, _PAPER_FONT)
            for kind in kinds:
                made[f"{name}.{kind}"] = _saved(drawn, kind)
    return made


def _saved(drawn: Figure, kind: str) -> bytes:
    if kind == "svg":
        return _CONDITION.sub("<g>", _svg(drawn)).encode()
    buffer = io.BytesIO()
    metadata = {"CreationDate": None} if kind == "pdf" else {}
    drawn.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()


def _svg(drawn: Figure) -> str:
    buffer = io.StringIO()
    drawn.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _settings(font: float, colours: tuple[str, str, str]) -> Any:
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
        # A task may be called $x_{1$.
        "text.parse_math": False,
        # The same figure is the same file.
        "svg.hashsalt": "music_rllib",
    }


def drawn_figure(panels: Sequence[Panel], legend: Legend, width: float, font: float) -> Figure:
    """Panels in rows, and the legend below.

    Margins are fixed: matplotlib's own layout takes longer than everything else together.
    """
    scale = font / _PAGE_FONT
    in_a_row = min(len(panels), _PANELS_IN_A_ROW) if width > 1.5 * COLUMN_WIDTH else 1
    rows = [panels[i : i + in_a_row] for i in range(0, len(panels), in_a_row)]
    heights = [max(panel.height for panel in row) * scale for row in rows]
    entries, columns = _legend_grid(legend, width, scale)
    in_rows = [entries[row :: _rows(entries, columns)] for row in range(_rows(entries, columns))]
    lines = sum(max(label.count("\n") + 1 for label, _ in row) for row in in_rows if row)
    below = (_LINE * lines + 0.1) * scale if entries else 0.0
    whole = sum(heights) + below
    figure = Figure(figsize=(width, whole))
    FigureCanvasAgg(figure)
    top = whole
    for row, height in zip(rows, heights, strict=True):
        for number, panel in enumerate(row):
            cell = (number * width / in_a_row, top - height, width / in_a_row, height)
            _place(figure, panel, cell, (width, whole), scale)
        top -= height
    if entries:
        handles = [
            Line2D(
                [], [], color=style.colour, marker=style.marker, linestyle=style.stroke, label=label
            )
            for label, style in entries
        ]
        figure.legend(handles=handles, loc="lower center", ncols=columns, frameon=False)
    return figure


def _place(
    figure: Figure,
    panel: Panel,
    cell: tuple[float, float, float, float],
    whole: tuple[float, float],
    scale: float,
) -> None:
    """Draw a panel into its cell: left, bottom, width and height in inches."""
    left, bottom, width, height = cell
    x, y = left + _LEFT * scale, bottom + _BOTTOM * scale
    across = width - (_LEFT + _RIGHT) * scale
    axes = figure.add_axes(
        (
            x / whole[0],
            y / whole[1],
            across / whole[0],
            (height - (_BOTTOM + panel.top) * scale) / whole[1],
        )
    )
    axes.patch.set_alpha(0.0)
    figure.text(
        (x + across / 2) / whole[0],
        (bottom + height - 0.07 * scale) / whole[1],
        panel.title,
        ha="center",
        va="top",
        size="large",
    )
    panel.draw(axes)


def _legend_grid(legend: Legend, width: float, scale: float) -> tuple[Legend, int]:
    """Labels broken to fit into the figure, and how many of them stand side by side."""
    letter, handle = _LETTER * scale, _HANDLE * scale
    most = max(12, int((width - handle - 0.2) / letter))
    entries = [(textwrap.fill(label, most), style) for label, style in legend]
    longest = max((len(line) for label, _ in entries for line in label.split("\n")), default=0)
    return entries, max(1, int(width / (handle + letter * longest)))


def _rows(entries: Legend, columns: int) -> int:
    return max(1, math.ceil(len(entries) / columns))


def stale_files(kept: set[str], names: Sequence[str]) -> Iterator[str]:
    """Of the `names` of files those of figures that are not among the `kept`."""
    for name in names:
        stem, dot, ending = name.rpartition(".")
        if dot + ending in ENDINGS and stem.removesuffix(COLUMN) not in kept:
            yield name
