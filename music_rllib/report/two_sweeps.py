"""A report on two sweeps: both as one sweep, and tables of their differences."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.analysis import FinalScores, StageAnalysis
from music_rllib.results.archive import merged
from music_rllib.results.conditions import sorting_key
from music_rllib.results.data import RunRecord, Sweep
from music_rllib.results.tables import Table

MOST_VALUES = 6
"""Largest number of a setting's values that are listed for one sweep."""


def joined_sweeps(first: Sweep, second: Sweep) -> Sweep:
    """All runs of both sweeps; stage names begin with the sweep, so that stages are compared."""
    titles = titles_of(first, second)
    both = merged(*map(_renamed, (first, second), titles))
    return replace(
        both, name=" and ".join(titles), config=None, plans=(), searches=(), earlier=None
    )


def titles_of(first: Sweep, second: Sweep) -> tuple[str, str]:
    """Two different names."""
    if first.name != second.name:
        return first.name, second.name
    return f"{first.name} (first)", f"{second.name} (second)"


def _renamed(sweep: Sweep, title: str) -> Sweep:
    return replace(sweep, runs=[_renamed_run(run, title) for run in sweep.runs])


def _renamed_run(run: RunRecord, title: str) -> RunRecord:
    """The run with the sweep's title in its name, stage and node keys.

    A run that both sweeps have is two runs, as each of the sweeps is reported with all its runs.
    """
    keys = (names.TAG_NODE_KEY, names.TAG_SOURCE_NODE)
    links = {tag: f"{title}/{run.tags[tag]}" for tag in keys if run.tags.get(tag)}
    stage = {names.TAG_STAGE: f"{title}: {run.stage}"}
    return replace(run, name=f"{title}: {run.name}", tags={**run.tags, **links, **stage})


def difference_tables(
    first: Sweep, second: Sweep, analyses: Sequence[StageAnalysis]
) -> list[Table]:
    """Settings that differ, and the final values of all conditions in both sweeps.

    The `analyses` are those of the sweep that :func:`joined_sweeps` makes of them.
    """
    titles = titles_of(first, second)
    return [_settings_table(first, second, titles), _results_table(analyses, titles)]


def _settings_table(first: Sweep, second: Sweep, titles: tuple[str, str]) -> Table:
    one, other = _setting_values(first), _setting_values(second)
    stages = [{stage for stage, _ in values} for values in (one, other)]
    rows: list[tuple[str | None, ...]] = [
        (*key, _values_text(one.get(key)), _values_text(other.get(key)))
        for key in sorted({*one, *other})
        if one.get(key) != other.get(key) and key[0] in stages[0] & stages[1]
    ]
    rows += [
        (stage, "the stage itself", *("yes" if stage in own else "no" for own in stages))
        for stage in sorted(stages[0] ^ stages[1])
    ]
    return Table(
        title="Settings that differ",
        header=("In stage", "Setting", *titles),
        rows=rows or [("all", "none", None, None)],
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


def _values_text(values: set[str] | None) -> str | None:
    if not values:
        return None
    more = len(values) - MOST_VALUES
    text = ", ".join(sorted(values, key=sorting_key)[:MOST_VALUES])
    return text + (f" and {more} more" if more > 0 else "")


def _results_table(analyses: Sequence[StageAnalysis], titles: tuple[str, str]) -> Table:
    # Without the task's reward, success is chance.
    rewarded = [one for one in analyses if one.stage.has_task_reward] or analyses
    one, other = (_finals(rewarded, title) for title in titles)
    rows = []
    for key in dict.fromkeys((*one, *other)):
        found = [finals[key].estimate if key in finals else None for finals in (one, other)]
        first, second = found
        gap = st.difference(second, first) if first is not None and second is not None else None
        rows.append((*key, *found, gap))
    return Table(
        title="Final values of both sweeps",
        header=("In stage", "Task", "Condition", *titles, "Difference"),
        rows=rows,
        note="Means of the last evaluation of finished runs with their 95% CI. Difference: second "
        "sweep minus first sweep.",
    )


def _finals(
    analyses: Sequence[StageAnalysis], title: str
) -> dict[tuple[str, str, str], FinalScores]:
    """Final values of a sweep by stage, task and condition, without its title."""
    start = f"{title}: "
    in_label = re.compile(rf"(^|, ){re.escape(start)}")
    return {
        # A setting of what a condition starts from has the sweep's title, too.
        (
            analysis.stage.name.removeprefix(start),
            scope.name,
            in_label.sub(r"\1", final.condition.label),
        ): final
        for analysis in analyses
        if analysis.stage.name.startswith(start)
        for scope in analysis.scopes
        for final in scope.finals
    }
