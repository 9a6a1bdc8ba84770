"""A table of a report, which is shown on the page and is, unrounded, a CSV file."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from music_rllib.results.statistics import SHOW_SEEDS_BELOW, Estimate, number

DASH = "–"
"""Stands in a table for a missing value."""
LONG = 40
"""Number of letters from which on the text of a cell is wrapped."""


class Share(float):
    """A number that the page shows in percent."""


class Difference(float):
    """A number that the page shows with its sign."""


class Seconds(float):
    """A duration that the page shows as h:min:s."""


class Code(str):
    """A text that the page shows in a fixed-width font."""

    __slots__ = ()


class Cell(NamedTuple):
    """A cell of the page."""

    text: str
    kind: str = ""
    """CSS class: `number` (right-aligned), `long` (wraps over several lines) or empty."""
    code: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the page; one without rows is not shown."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    """Texts, numbers, lists (long ones are only in the file), `Share`, `Seconds`, `Code`, None for
    a missing value, and estimates, which take two columns: value and 95% CI."""
    note: str = ""
    name: str = ""
    """Name of its CSV file; empty: it has none."""
    folded: bool = False

    @cached_property
    def _shown(self) -> list[tuple[int, bool]]:
        """Numbers of the columns on the page, and whether they are estimates.

        The stage is left out if there is only one.
        """
        columns = list(zip(*self.rows, strict=True)) or [()] * len(self.header)
        return [
            (i, any(isinstance(value, Estimate) for value in column))
            for i, (name, column) in enumerate(zip(self.header, columns, strict=True))
            if name != "Stage" or len(set(column)) > 1 or len(self.header) < 3
        ]

    @property
    def heads(self) -> list[tuple[str, str]]:
        """Each column's name on the page, and the kind of its first cell."""
        titles: list[str] = []
        for i, is_estimate in self._shown:
            titles += [self.header[i], "95% CI"] if is_estimate else [self.header[i]]
        kinds = [cell.kind for cell in self.cells[0]] if self.rows else [""] * len(titles)
        return list(zip(titles, kinds, strict=True))

    @cached_property
    def cells(self) -> list[list[Cell]]:
        """The rows as texts for the page."""
        return [
            [
                cell
                for i, is_estimate in self._shown
                for cell in (_estimate(row[i]) if is_estimate else [_cell(row[i])])
            ]
            for row in self.rows
        ]

    def to_csv(self) -> str:
        """The unrounded values; an estimate has the columns `x`, `x_lower` and `x_upper`."""
        rows: list[dict[str, object]] = []
        for row in self.rows:
            values: dict[str, object] = {}
            for title, value in zip(self.header, row, strict=True):
                column = re.sub(r"\W+", "_", title.lower()).strip("_")
                if isinstance(value, Estimate):
                    values[column] = float(value.value)
                    values[f"{column}_lower"] = float(value.lower)
                    values[f"{column}_upper"] = float(value.upper)
                else:
                    values[column] = value
            rows.append(values)
        return to_csv(rows)


def to_csv(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows below a header; NaN is `nan`, infinity `inf`, and None is empty."""
    buffer = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    return buffer.getvalue()


def _plain(value: object) -> object:
    """`0 1 2` for a list, and `0:0.5 1:0.6` for a mapping."""
    if isinstance(value, Mapping):
        return " ".join(f"{key}:{one:g}" for key, one in value.items())
    return " ".join(map(str, value)) if isinstance(value, list) else value


def estimate_of(value: float, lower: float, upper: float) -> Estimate:
    """An estimate of numbers; NaN: it has no interval."""
    return Estimate(value=np.array(value), lower=np.array(lower), upper=np.array(upper))


def _cell(value: object) -> Cell:
    if value is None:
        return Cell(DASH)
    if isinstance(value, Code):
        return Cell(value, "long" if len(value) > LONG else "", code=True)
    if isinstance(value, list) and len(value) >= SHOW_SEEDS_BELOW:
        return Cell(DASH)
    if isinstance(value, list):
        return Cell(" ".join(one if isinstance(one, str) else _number(one) for one in value))
    if isinstance(value, float):
        return Cell(_number(value), "number")
    if isinstance(value, int) and not isinstance(value, bool):
        return Cell(f"{value:,}", "number")
    text = str(value)
    return Cell(text, "long" if len(text) > LONG else "")


def _number(value: float) -> str:
    if math.isnan(value):
        return DASH
    if isinstance(value, Share):
        return f"{value:.0%}"
    if isinstance(value, Difference):
        return f"{value:+.3g}"
    if isinstance(value, Seconds):
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
    return "not reached" if math.isinf(value) else number(value)


def _estimate(value: object) -> list[Cell]:
    """An estimate's value and its 95% CI."""
    if not isinstance(value, Estimate):
        return [Cell(DASH, "number"), Cell(DASH)]
    low, high = float(value.lower), float(value.upper)
    interval = "no interval" if math.isnan(low) else f"{_number(low)} to {_number(high)}"
    return [Cell(_number(float(value.value)), "number"), Cell(interval)]
