"""Two sweeps as one: what differs in their settings and in what came of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from music_rllib import names
from music_rllib.report.pieces import TextTable, number
from music_rllib.results import statistics as st
from music_rllib.results.analysis import StageAnalysis
from music_rllib.results.archive.merge import merged
from music_rllib.results.comparison import Final, interval_text
from music_rllib.results.comparison import number as in_short
from music_rllib.results.conditions import Condition
from music_rllib.results.data import RunRecord, Sweep

__all__ = ["difference_tables", "side_by_side"]

_LINKS = (names.TAG_NODE_KEY, names.TAG_SOURCE_NODE)
MOST_VALUES = 6
"""Of a setting in one sweep, that are shown."""
DASH = "–"


def side_by_side(first: Sweep, second: Sweep) -> Sweep:
    """All runs of both; stages are called by their sweep, so that they are compared."""
    one, other = _titles(first, second)
    both = merged(_renamed(first, one), _renamed(second, other))
    return replace(both, name=f"{one} and {other}", config=None, plans=(), searches=())


def _titles(first: Sweep, second: Sweep) -> tuple[str, str]:
    if first.name != second.name:
        return first.name, second.name
    return f"{first.name} (first)", f"{second.name} (second)"


def _renamed(sweep: Sweep, title: str) -> Sweep:
    """Runs that both have by the same node are two all the same: otherwise one would lack it."""
    return replace(sweep, runs=[_of(run, title) for run in sweep.runs])


def _of(run: RunRecord, title: str) -> RunRecord:
    links = {tag: f"{title}/{run.tags[tag]}" for tag in _LINKS if run.tags.get(tag)}
    stage = {names.TAG_STAGE: f"{title}: {run.stage}"}
    return replace(run, name=f"{title}: {run.name}", tags={**run.tags, **links, **stage})


def difference_tables(
    first: Sweep, second: Sweep, analyses: Sequence[StageAnalysis]
) -> list[TextTable]:
    """What was set otherwise, and what conditions that both have came to.

    Args:
        first: as it was read, as is `second`.
        second: the other.
        analyses: of both as one, by :func:`side_by_side`.
    """
    titles = _titles(first, second)
    return [_settings(first, second, titles), _results(analyses, titles)]


def _settings(first: Sweep, second: Sweep, titles: tuple[str, str]) -> TextTable:
    one, other = _values(first), _values(second)
    rows = [
        (stage, setting, *(_shown(found.get((stage, setting))) for found in (one, other)))
        for stage, setting in sorted({*one, *other})
        if one.get((stage, setting)) != other.get((stage, setting))
    ]
    return TextTable(
        title="Settings that differ",
        header=("Stage", "Setting", *titles),
        rows=rows or [("all", "none", DASH, DASH)],
    )


def _values(sweep: Sweep) -> Mapping[tuple[str, str], set[str]]:
    found: dict[tuple[str, str], set[str]] = {}
    for run in sweep.runs:
        about = {
            name: value
            for name, value in run.tags.items()
            if name == names.TAG_ALGORITHM or name == names.TAG_VARIANT
        }
        for name, value in {**run.params, **about}.items():
            found.setdefault((run.stage, name), set()).add(value)
    return found


def _shown(values: set[str] | None) -> str:
    if not values:
        return DASH
    more = len(values) - MOST_VALUES
    return ", ".join(sorted(values)[:MOST_VALUES]) + (f" and {more} more" if more > 0 else "")


def _results(analyses: Sequence[StageAnalysis], titles: tuple[str, str]) -> TextTable:
    ended = [
        {
            (
                analysis.stage.name.removeprefix(f"{title}: "),
                scope.name,
                final.condition.label,
            ): final
            for analysis in analyses
            if analysis.stage.name.startswith(f"{title}: ")
            for scope in analysis.scopes
            for final in scope.finals
        }
        for title in titles
    ]
    one, other = ended
    rows = []
    for key in dict.fromkeys((*one, *other)):
        pair = one.get(key), other.get(key)
        gap = None
        if pair[0] is not None and pair[1] is not None:
            gap = st.difference(pair[1].estimate, pair[0].estimate)
        rows.append(
            (
                *key,
                *map(_mean, pair),
                number(DASH if gap is None else f"{float(gap.value):+.3g}"),
                DASH if gap is None else interval_text(gap),
            )
        )
    return TextTable(
        title="Results of both",
        header=("Stage", "Task", "Condition", *titles, "Difference", "95 % interval"),
        rows=rows,
        note="Means of the last evaluation of finished runs with their 95 % intervals; the "
        "difference is the second's minus the first's.",
    )


def _mean(final: Final[Condition] | None) -> str:
    if final is None or np.isnan(final.value):
        return DASH
    return f"{in_short(final.value)} ({interval_text(final.estimate)})"
