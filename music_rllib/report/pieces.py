"""The page's pieces as plain data; `page.html` makes HTML of them and escapes every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from music_rllib.report.figures.palette import Style

__all__ = ["Cell", "Figure", "TextTable", "document", "number"]

# Nothing may be fetched or run, whatever finds its way into a page. Matplotlib's drawings have
# style attributes, for which no hash can stand.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; "
    "base-uri 'none'; form-action 'none'"
)
_DASHES = {"solid": "", "dashed": "6 3", "dashdot": "6 2 1.5 2", "dotted": "1.5 2.5"}
_MARKS = {"o": "●", "s": "■", "D": "◆", "^": "▲", "v": "▼", "P": "✚", "X": "✖", "*": "★"}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A table's cell that is more than short text."""

    text: str
    kind: str = ""
    """`number`, which stands right, or `long`, which has several lines."""
    code: bool = False
    url: str | None = None
    """Where it leads."""


def number(shown: str) -> Cell:
    """A number that is text already."""
    return Cell(text=shown, kind="number")


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table of the page; one without rows is not shown."""

    title: str
    note: str = ""
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    """Texts, numbers and cells."""
    long: bool = False
    """Whether it is folded."""

    @cached_property
    def cells(self) -> list[list[Cell]]:
        """The rows, each value as a cell."""
        return [[_cell(value) for value in row] for row in self.rows]

    @property
    def heads(self) -> list[tuple[str, str]]:
        """Each column's name, and the kind of its first cell."""
        kinds = [cell.kind for cell in self.cells[0]] if self.cells else [""] * len(self.header)
        return list(zip(self.header, kinds, strict=True))


def _cell(value: object) -> Cell:
    if isinstance(value, Cell):
        return value
    return Cell(text=str(value), kind="number" if isinstance(value, int | float) else "")


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A drawing of the page."""

    name: str
    title: str
    caption: str
    legend: Sequence[tuple[str, Style]]
    panels: Sequence[tuple[str, str]]
    """What each shows in words, and its SVG element."""


_PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def document(**content: Any) -> str:
    """The whole page, with its style inside; what `page.html` names is the `content`."""
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    page = _PAGES.get_template("page.html")
    return (
        page.render(style=style, policy=_POLICY, dashes=_DASHES, marks=_MARKS, **content).strip()
        + "\n"
    )
