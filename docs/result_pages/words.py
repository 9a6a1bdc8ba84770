"""Table rows and formatted numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from music_rllib.results import statistics as st
from music_rllib.results.analysis import FinalScores
from music_rllib.results.statistics import number

THRESHOLD = 0.9
"""Success rate of the proofs in the appendix."""


def row(*cells: object) -> str:
    """A table row."""
    return "| " + " | ".join(map(str, cells)) + " |"


def rule(columns: int) -> str:
    """The line below a table header."""
    return "|" + "---|" * columns


def rate_cells(final: FinalScores | None) -> tuple[str, str]:
    """A final rate with its interval, and the rate of each seed; empty without a finished seed."""
    if final is None:
        return "", ""
    found = final.estimate
    value, each = percent(final.value), ", ".join(f"{100 * x:.0f}" for x in _each_seed(final))
    if not found.has_interval:
        return f"{value} (one seed)", each
    return f"{value} [{percent(float(found.lower))}, {percent(float(found.upper))}]", each


def _each_seed(final: FinalScores) -> list[float]:
    """Sorted rates of the seeds; empty if there are too many to show."""
    rates = final.scores.mean(axis=1).tolist()
    return sorted(rates) if final.seeds < st.SHOW_SEEDS_BELOW else []


def spread(found: st.Estimate) -> str:
    """`0.57 [0.53, 0.61]`."""
    if not np.isfinite(found.value):
        return ""
    value, lower, upper = (number(float(x)) for x in (found.value, found.lower, found.upper))
    return f"{value} [{lower}, {upper}]" if found.has_interval else value


def percent(share: float) -> str:
    """`57%`."""
    return f"{100 * share:.0f}%"


def wait_text(median: st.Estimate) -> str:
    """A median number of steps with its interval, if it has one."""
    value, low, high = (
        f"{steps:,.0f}" if np.isfinite(steps) else "not reached"
        for steps in (median.value, median.lower, median.upper)
    )
    return value if np.isnan(median.lower) else f"{value} [{low}, {high}]"


def clock(seconds: float | None) -> str:
    """`7:05`."""
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"


def all_of(values: Iterable[str]) -> str:
    """The distinct values, as code."""
    return ", ".join(f"`{value}`" for value in sorted(set(values) - {""}))


def natural(name: str) -> list[tuple[int, int | str]]:
    """Sorting key: seed10 after seed9."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]
