"""The page's pieces as plain data; `page.html` makes HTML of them and escapes every text."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from jinja2.utils import htmlsafe_json_dumps

from music_rllib.report.figures.palette import DASHES, Style

__all__ = ["Cell", "Figure", "Panels", "TextTable", "document", "number"]

# Nothing may be fetched, and nothing run but the page's own script, whatever finds its way into a
# page. Matplotlib's drawings have style attributes, for which no hash can stand.
_POLICY = (
    "default-src 'none'; script-src 'sha256-{script}'; connect-src {connect}; "
    "style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
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
class Panels:
    """What a figure shows without a script: the panels of one stage."""

    name: str
    stage: str
    """Empty where the figure has one only."""
    number: int
    """Of the stage in the page's data; -1 where it is not there."""
    legend: Sequence[tuple[str, Style]]
    panels: Sequence[tuple[str, str, str]]
    """What each shows in words, its title, and its SVG element."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of the page."""

    name: str
    title: str
    caption: str
    metric: str | None
    """Whose curves the page's script draws; empty: the one that the reader chooses."""
    stages: Sequence[Panels]

    @property
    def span(self) -> str:
        """Over how many of the page's columns it goes."""
        panels = sum(len(stage.panels) for stage in self.stages)
        return ("one", "two", "three")[min(panels, 3) - 1]


_PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "web"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def document(data: Any, *, live: bool, **content: Any) -> str:
    """The whole page, with its style and scripts inside.

    Args:
        data: what its script draws.
        live: whether it follows a sweep on the server that it came from.
        content: what `page.html` names.
    """
    scripts = ("chart.js", "page.js", *(("live.js",) if live else ()))
    script = "\n".join(_own(name) for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = _PAGES.get_template("page.html").render(
        style=_own("page.css"),
        script=script,
        # As JSON, in which no text can end the element.
        data=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        policy=_POLICY.format(script=digest, connect="'self'" if live else "'none'"),
        dashes=DASHES,
        marks=_MARKS,
        live=live,
        **content,
    )
    return page.strip() + "\n"


def _own(name: str) -> str:
    return (Path(__file__).parent / "web" / name).read_text(encoding="utf-8")
