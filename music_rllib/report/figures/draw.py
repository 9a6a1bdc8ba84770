"""Drawing of figures: SVG elements for the page, and a PNG and an SVG file for a paper.

A figure has its own canvas and does not use pyplot, so that no display is needed. On the page each
subplot is an SVG element in the page's colors, so that it fits a narrow window and follows light
and dark mode. A file has all subplots together.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from itertools import chain
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from music_rllib.report.figures.choice import Drawing
from music_rllib.report.figures.plots import HEIGHT, Legend, Subplot, legend_handles

TEXT_WIDTH = 7.16
"""Width in inches of a paper's text."""
_ON_PAGE = 4.3
"""Width in inches, at which 10 pt are readable on a page of 400 px."""
_PAGE_FONT, _PAPER_FONT = 10.0, 8.0
_DPI = 150
_LETTER = 0.07
"""Width in inches of a letter in a legend."""
_LETTERS_OF_AN_AXIS = 12
"""Letters per inch of a subplot in a line of the labels of its axes."""

# Matplotlib draws with the first colors, and the page's own colors then replace them in the SVG.
_STAND_INS = ("#010203", "#040506", "#070809")
_OF_THE_PAGE = ("currentColor", "var(--grid)", "var(--paper)")
_ON_PAPER = ("#1a1a1a", "#d9d9d9", "#ffffff")


def inline(drawing: Drawing) -> tuple[str, ...]:
    """Each subplot as an SVG element for the page."""
    return tuple(
        _inline(subplot, f"{drawing.name}-{number}")
        for number, subplot in enumerate(drawing.subplots)
    )


def _inline(subplot: Subplot, name: str) -> str:
    """A subplot as an SVG element whose ids begin with `name`, to be unique in the page.

    Matplotlib escapes all texts.
    """
    with mpl.rc_context(_settings(_PAGE_FONT, _STAND_INS)):
        figure = drawn_figure([subplot], [], _ON_PAGE)
        figure.patch.set_alpha(0.0)
        text = _svg(figure)
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", text[text.index("<svg") :])
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, color in zip(_STAND_INS, _OF_THE_PAGE, strict=True):
        text = text.replace(stand_in, color)
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', "", text, count=1)
    return re.sub(r">\s+<", "><", text)


def files(subplots: Sequence[Subplot], legend: Legend) -> dict[str, bytes]:
    """All subplots on white paper with a legend, as `.png` (150 dpi) and as `.svg`."""
    with mpl.rc_context(_settings(_PAPER_FONT, _ON_PAPER) | {"svg.fonttype": "path"}):
        figure = drawn_figure(subplots, legend, TEXT_WIDTH)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
        return {".png": buffer.getvalue(), ".svg": _svg(figure).encode()}


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _settings(font: float, colors: tuple[str, str, str]) -> Any:
    """Matplotlib's settings for text of `font` points and the colors of ink, grid and paper."""
    ink, grid, paper = colors
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
        "axes.titlesize": "large",
        "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
        "font.size": font,
        "xtick.labelsize": 0.9 * font,
        "ytick.labelsize": 0.9 * font,
        "svg.fonttype": "none",
        # The name of a task may not be a valid formula, like $x_{1$.
        "text.parse_math": False,
        # Ids in an SVG do not depend on the time, so that the same figure is the same file.
        "svg.hashsalt": "music_rllib",
    }


def drawn_figure(subplots: Sequence[Subplot], legend: Legend, width: float) -> Figure:
    """A figure with the subplots in rows and the legend below them."""
    has_rows = any(subplot.height > HEIGHT for subplot in subplots)
    most = 2 if has_rows or len(subplots) == 4 else 3
    columns = min(len(subplots), most) if width > _ON_PAGE else 1
    rows = [subplots[i : i + columns] for i in range(0, len(subplots), columns)]
    scale = min(1.1, max(0.8, width / (columns * _ON_PAGE)))
    heights = [scale * max(subplot.height for subplot in row) for row in rows]
    legend = [(textwrap.fill(label, int(width / _LETTER)), style) for label, style in legend]
    longest = max((len(line) for label, _ in legend for line in label.split("\n")), default=0)
    entries = max(1, int(width / (0.5 + _LETTER * longest)))
    lines = sum(label.count("\n") + 1 for label, _ in legend) / entries
    figure = Figure(figsize=(width, sum(heights) + 0.2 * lines), dpi=_DPI)
    grid = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for axes in grid.flat[len(subplots) :]:
        axes.set_axis_off()
    for axes, subplot in zip(grid.flat, chain(*rows), strict=False):
        inches = subplot.plot_width * width / columns
        axes.set_title(_wrapped(subplot.title, inches, 100 / mpl.rcParams["font.size"]))
        axes.patch.set_alpha(0.0)
        subplot.draw(axes)
        axes.set_xlabel(_wrapped(axes.get_xlabel(), width / columns))
        axes.set_ylabel(_wrapped(axes.get_ylabel(), scale * subplot.height))
    if legend:
        handles = legend_handles(legend)
        figure.legend(handles=handles, loc="outside lower center", ncols=entries, frameon=False)
    ConstrainedLayoutEngine().execute(figure)  # an engine of the figure would draw it once more
    return figure


def _wrapped(label: str, inches: float, letters: float = _LETTERS_OF_AN_AXIS) -> str:
    """The label in lines of at most `inches`, at this number of letters per inch."""
    lines = (textwrap.fill(line, int(letters * inches)) for line in label.split("\n"))
    return "\n".join(lines)
