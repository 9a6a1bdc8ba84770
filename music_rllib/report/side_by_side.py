"""Two sweeps as one, and tables of how their settings and results differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from music_rllib import names
from music_rllib.report.pieces import DASH, TextTable, number_cell
from music_rllib.results import statistics as st
from music_rllib.results.analysis import FinalScores, StageAnalysis
from music_rllib.results.archive import merged
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.results.statistics import interval_text, number

MOST_VALUES = 6
"""Largest number of a setting's values that are shown for one sweep."""


def side_by_side(first: Sweep, second: Sweep) -> Sweep:
    """All runs of both sweeps; stage names begin with the sweep, so that stages are compared."""
    titles = _titles(first, second)
    both = merged(_renamed(first, titles[0]), _renamed(second, titles[1]))
    return replace(
        both, name=" and ".join(titles), config=None, plans=(), searches=(), earlier=None
    )


def _titles(first: Sweep, second: Sweep) -> tuple[str, str]:
    if first.name != second.name:
        return first.name, second.name
    return f"{first.name} (first)", f"{second.name} (second)"


def _renamed(sweep: Sweep, title: str) -> Sweep:
    return replace(sweep, runs=[_renamed_run(run, title) for run in sweep.runs])


def _renamed_run(run: RunRecord, title: str) -> RunRecord:
    """The run with the sweep's title in its name, stage and node keys.

    A run that both sweeps took from the same node counts twice: otherwise one of them would lack
    it.
    """
    keys = (names.TAG_NODE_KEY, names.TAG_SOURCE_NODE)
    links = {tag: f"{title}/{run.tags[tag]}" for tag in keys if run.tags.get(tag)}
    stage = {names.TAG_STAGE: f"{title}: {run.stage}"}
    return replace(run, name=f"{title}: {run.name}", tags={**run.tags, **links, **stage})


def difference_tables(
    first: Sweep, second: Sweep, analyses: Sequence[StageAnalysis]
) -> list[TextTable]:
    """Settings that differ, and the final values of all conditions in both sweeps.

    Args:
        first: the first sweep as it was read.
        second: the second sweep as it was read.
        analyses: of the sweep that :func:`side_by_side` makes of them.
    """
    titles = _titles(first, second)
    return [_settings_table(first, second, titles), _results_table(analyses, titles)]


def _settings_table(first: Sweep, second: Sweep, titles: tuple[str, str]) -> TextTable:
    one, other = _setting_values(first), _setting_values(second)
    rows = [
        (*key, _values_text(one.get(key)), _values_text(other.get(key)))
        for key in sorted({*one, *other})
        if one.get(key) != other.get(key)
    ]
    return TextTable(
        title="Settings that differ",
        header=("Stage", "Setting", *titles),
        rows=rows or [("all", "none", DASH, DASH)],
    )


def _setting_values(sweep: Sweep) -> Mapping[tuple[str, str], set[str]]:
    """The values of each (stage, setting)."""
    about = (names.TAG_ALGORITHM, names.TAG_VARIANT)
    values: dict[tuple[str, str], set[str]] = {}
    for run in sweep.runs:
        tags = {tag: run.tags[tag] for tag in about if tag in run.tags}
        for name, value in {**run.params, **tags}.items():
            values.setdefault((run.stage, name), set()).add(value)
    return values


def _values_text(values: set[str] | None) -> str:
    if not values:
        return DASH
    more = len(values) - MOST_VALUES
    return ", ".join(sorted(values)[:MOST_VALUES]) + (f" and {more} more" if more > 0 else "")


def _results_table(analyses: Sequence[StageAnalysis], titles: tuple[str, str]) -> TextTable:
    one, other = (
        {
            # A setting of what a condition starts from has the sweep's title, too.
            (
                analysis.stage.name.removeprefix(start),
                scope.name,
                final.condition.label.replace(start, ""),
            ): final
            for analysis in analyses
            if analysis.stage.name.startswith(start)
            for scope in analysis.scopes
            for final in scope.finals
        }
        for start in (f"{title}: " for title in titles)
    )
    rows = []
    for key in dict.fromkeys((*one, *other)):
        first, second = one.get(key), other.get(key)
        difference, interval = DASH, DASH
        if first is not None and second is not None:
            gap = st.difference(second.estimate, first.estimate)
            difference, interval = f"{float(gap.value):+.3g}", interval_text(gap)
        rows.append((*key, _mean(first), _mean(second), number_cell(difference), interval))
    return TextTable(
        title="Results of both",
        header=("Stage", "Task", "Condition", *titles, "Difference", "95 % interval"),
        rows=rows,
        note="Means of the last evaluation of finished runs with their 95 % intervals; the "
        "difference is the second's minus the first's.",
    )


def _mean(final: FinalScores | None) -> str:
    if final is None or np.isnan(final.value):
        return DASH
    return f"{number(final.value)} ({interval_text(final.estimate)})"
