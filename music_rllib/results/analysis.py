"""What a sweep's runs say, in numbers: every stage's, on each of its tasks.

Only finished runs have a final score, the last evaluation's, of their task's primary metric. Curves
and steps to a threshold take every run as far as it went: one that failed or is still running is
censored there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.comparison import ALL_TASKS, Scope, scopes_of
from music_rllib.results.conditions import Condition, Stage, find_stages, stage_by_stage
from music_rllib.results.data import Ints, Sweep
from music_rllib.results.statistics import Array, Estimate
from music_rllib.results.time_to_threshold import (
    Race,
    Waits,
    median_wait,
    median_wait_interval,
    races,
    waits_of,
)

__all__ = ["Curve", "Entropies", "StageAnalysis", "Wait", "analyse", "analyse_stages", "curve"]

THRESHOLDS = (0.5, 0.85)
"""Success rates whose first evaluation is looked for; the paper's Figure 4 has 85 %."""
CURVE_POINTS = 101
"""More cannot be told apart in a figure."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Environment steps until a condition reaches a success rate on a task."""

    condition: Condition
    task: str
    threshold: float
    waits: Waits
    """Of each run."""
    median: float
    """Infinite where fewer than half of the runs got there."""
    lower: float
    """NaN where there are too few runs for an interval."""
    upper: float

    @property
    def runs(self) -> int:
        return len(self.waits.steps)

    @property
    def reached(self) -> int:
        return int(self.waits.reached.sum())


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A metric of a condition on a task against environment steps."""

    condition: Condition
    task: str
    steps: Array
    """`[points]`."""
    values: Array
    """`[R, points]`, NaN where a run had not begun or had ended."""
    estimate: Estimate
    """`[points]`."""
    runs: Ints
    """`[points]`: how many runs there are that far."""


class Entropies(NamedTuple):
    """How random policies are at the end, means over finished runs; None where there is no entropy.

    S_q has the run's own q and form, so that its values at different q are not to be compared.
    """

    shannon: Estimate | None
    """In nats, over all action dimensions."""
    tsallis: Estimate | None

    @property
    def numbers(self) -> list[float]:
        """Mean and ends of both, NaN where there is none."""
        ends = ((one.value, one.lower, one.upper) if one else (np.nan,) * 3 for one in self)
        return [float(end) for three in ends for end in three]


@dataclass(frozen=True, kw_only=True)
class StageAnalysis:
    """All numbers of one stage."""

    stage: Stage
    scopes: tuple[Scope[Condition], ...]
    waits: tuple[Wait, ...]
    races: tuple[Race, ...]
    """Of each pair of conditions, to each threshold."""
    entropies: Mapping[tuple[str, Condition], Entropies]
    """By scope and condition."""


def analyse(sweep: Sweep) -> list[StageAnalysis]:
    """The numbers of each stage."""
    return [_analyse(sweep, stage) for stage in find_stages(sweep)]


def _analyse(sweep: Sweep, stage: Stage) -> StageAnalysis:
    metrics = {task: sweep.primary_metric(task) for task in stage.tasks}
    scopes = scopes_of(
        metrics,
        [
            (one, _final_scores(sweep, one, metrics), sweep.episodes(one.runs))
            for one in stage.conditions
        ],
        stage.compared,
    )
    cells = [
        (task, threshold)
        for task, metric in metrics.items()
        if metric == names.EVAL_SUCCESS
        for threshold in THRESHOLDS
    ]
    waits = [
        wait
        for task, threshold in cells
        for condition in stage.conditions
        if (wait := _wait(sweep, condition, task, threshold)) is not None
    ]
    groups = {condition.label: condition.runs for condition in stage.compared}
    found = [race for task, threshold in cells for race in races(sweep, task, groups, threshold)]
    return StageAnalysis(
        stage=stage,
        scopes=scopes,
        waits=tuple(waits),
        races=tuple(found),
        entropies={
            (scope.name, final.condition): _entropies(sweep, final.condition, stage, scope.name)
            for scope in scopes
            for final in scope.finals
        },
    )


def _entropies(sweep: Sweep, condition: Condition, stage: Stage, scope: str) -> Entropies:
    tasks = stage.tasks if scope == ALL_TASKS else (scope,)
    runs = tuple(run for run in condition.runs if sweep.runs[run].task in tasks)
    found = []
    for metric in (names.SHANNON_ENTROPY, names.ENTROPY):
        scores = _final_scores(sweep, replace(condition, runs=runs), dict.fromkeys(tasks, metric))
        there = scores[~np.isnan(scores).any(axis=1)]
        found.append(st.estimate(there) if len(there) else None)
    return Entropies(*found)


def analyse_stages(sweep: Sweep, stages: Sequence[Stage]) -> StageAnalysis | None:
    """Stages that train for the task against each other, over the conditions that all have.

    Returns:
        None where there is nothing to compare.
    """
    together = stage_by_stage(sweep, stages)
    return None if together is None else _analyse(sweep, together)


def _final_scores(sweep: Sweep, condition: Condition, metrics: Mapping[str, str]) -> Array:
    """`[seeds, T]` last values of finished runs, NaN where there is none."""
    tasks = list(metrics)
    rows: dict[tuple[str, int], Array] = {}
    seen: Counter[tuple[str, str]] = Counter()
    for run in condition.runs:
        record = sweep.runs[run]
        # A condition of several q has a seed several times, in the same order on every task.
        key = (record.seed, seen[record.seed, record.task])
        seen[record.seed, record.task] += 1
        row = rows.setdefault(key, np.full(len(tasks), np.nan))
        score = sweep.final(run, metrics[record.task])
        if record.status == "FINISHED" and score is not None:
            row[tasks.index(record.task)] = score
    return np.array(list(rows.values())).reshape(len(rows), len(tasks))


def _wait(sweep: Sweep, condition: Condition, task: str, threshold: float) -> Wait | None:
    waits = waits_of(sweep, task, condition.runs, threshold)
    if waits is None:
        return None
    lower, upper = median_wait_interval(waits)
    return Wait(
        condition=condition,
        task=task,
        threshold=threshold,
        waits=waits,
        median=median_wait(waits),
        lower=lower,
        upper=upper,
    )


def curve(sweep: Sweep, condition: Condition, task: str, metric: str) -> Curve | None:
    """Mean over the runs at each step, each run as far as it went.

    Runs that were evaluated at other steps are read between their own points by straight lines,
    never before their first or after their last.

    Returns:
        None where no run has the metric.
    """
    runs = [run for run in condition.runs if sweep.runs[run].task == task]
    series = [pair for run in runs if len((pair := sweep.finite(run, metric))[0])]
    if not series:
        return None
    grid = np.unique(np.concatenate([steps for steps, _ in series]))
    if len(grid) > CURVE_POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, CURVE_POINTS).round().astype(int)]
    values = np.stack(
        [np.interp(grid, steps, found, left=np.nan, right=np.nan) for steps, found in series]
    )
    return Curve(
        condition=condition,
        task=task,
        steps=grid,
        values=values,
        estimate=st.estimate(
            values[:, np.newaxis],
            sweep.episodes(runs) if metric in names.EVAL_RATES else None,
        ),
        runs=np.sum(~np.isnan(values), axis=0),
    )
