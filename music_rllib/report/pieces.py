"""Tables of the page as data, and the page itself, whose template escapes all texts."""

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

from music_rllib.report.figures.palette import DASHES
from music_rllib.results.statistics import Estimate, interval_text, number

DASH = "–"
"""Stands in a table where there is no value."""
# The page may fetch nothing and run only its own script, whatever text a sweep puts into it.
# Styles cannot be restricted by a hash: matplotlib's SVGs have style attributes.
_POLICY = (
    "default-src 'none'; script-src 'sha256-{script}'; connect-src {connect}; "
    "style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
_MARKS = {"o": "●", "s": "■", "D": "◆", "^": "▲", "v": "▼", "P": "✚", "X": "✖", "*": "★"}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A table cell with a layout or a code font."""

    text: str
    kind: str = ""
    """CSS class: `number` (right-aligned), `long` (wraps over several lines) or empty."""
    code: bool = False


def number_cell(text: str) -> Cell:
    """A right-aligned cell with a formatted number."""
    return Cell(text=text, kind="number")


def estimate_cells(estimate: Estimate | None) -> tuple[Cell, str]:
    """An estimate's value and its 95 % interval; dashes where there is no estimate."""
    if estimate is None:
        return number_cell(DASH), DASH
    return number_cell(number(estimate.value)), interval_text(estimate)


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table of the page; one without rows is not shown."""

    title: str
    note: str = ""
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    """Each value is a text, a number or a :class:`Cell`."""
    long: bool = False
    """Whether the page shows it folded."""

    @cached_property
    def cells(self) -> list[list[Cell]]:
        """The rows with each value as a cell."""
        return [[_cell(value) for value in row] for row in self.rows]

    @property
    def heads(self) -> list[tuple[str, str]]:
        """Each column's name and the kind of its first cell."""
        kinds = [cell.kind for cell in self.cells[0]] if self.cells else [""] * len(self.header)
        return list(zip(self.header, kinds, strict=True))


def _cell(value: object) -> Cell:
    if isinstance(value, Cell):
        return value
    return Cell(text=str(value), kind="number" if isinstance(value, int | float) else "")


_PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "web"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def document(data: Any, *, live: bool, **content: Any) -> str:
    """Render the whole page, with its style and scripts inline.

    Args:
        data: the curves that its script draws.
        live: whether its script polls the server that it came from for the state of the sweep.
        content: the other variables of `page.html`.
    """
    scripts = ("chart.js", "page.js", "live.js") if live else ("chart.js", "page.js")
    script = "\n".join(_web_file(name) for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = _PAGES.get_template("page.html").render(
        style=_web_file("page.css"),
        script=script,
        # JSON in which no text can close the script element.
        data=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        policy=_POLICY.format(script=digest, connect="'self'" if live else "'none'"),
        dashes=DASHES,
        marks=_MARKS,
        live=live,
        **content,
    )
    return page.strip() + "\n"


def _web_file(name: str) -> str:
    return (Path(__file__).parent / "web" / name).read_text(encoding="utf-8")
