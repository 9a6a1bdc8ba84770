"""What a sweep's runs say, in numbers; `verdict` says it in words.

Only finished runs have a final success rate, the last evaluation's. Curves and steps to a threshold
take every run as far as it went: one that failed or is still running is censored there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from music_rllib.results import statistics as st
from music_rllib.results.conditions import Condition, Stage, find_stages, stage_by_stage
from music_rllib.results.data import Ints, Sweep
from music_rllib.results.races import Race, races
from music_rllib.results.statistics import SIGNIFICANCE, Array, Estimate
from music_rllib.results.time_to_threshold import (
    Waits,
    first_passage,
    median_wait,
    median_wait_interval,
)
from music_rllib.tracking import names

__all__ = [
    "ALL_TASKS",
    "Comparison",
    "Curve",
    "Final",
    "Scope",
    "StageAnalysis",
    "Wait",
    "analyse",
    "analyse_stages",
    "curve",
]

ALL_TASKS = "all tasks"
THRESHOLDS = (0.5, 0.85)
"""Success rates whose first evaluation is looked for; the paper's Figure 4 has 85 %."""
CURVE_POINTS = 101
"""More cannot be told apart in a figure."""
CURVE_RESAMPLES = 1000


@dataclass(frozen=True, kw_only=True)
class Final:
    """Final success rate of a condition."""

    condition: Condition
    scores: Array = field(repr=False)
    """`[seeds, T]` of finished runs."""
    estimate: Estimate

    @property
    def runs(self) -> int:
        return int(self.scores.size)

    @property
    def seeds(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Whether one condition's finished runs are better than another's."""

    first: Final
    second: Final
    estimate: Estimate
    """Probability that a run of `first` ends higher than one of `second`."""
    p_value: float
    """Of the permutation test, adjusted for the other comparisons in the scope (Holm)."""

    @property
    def overlaps(self) -> bool:
        """Whether the intervals of the two final success rates overlap, or one is missing."""
        return self.first.estimate.overlaps(self.second.estimate)

    @property
    def decided(self) -> bool:
        """Evidence: intervals apart, and a gap that relabelling the runs seldom makes."""
        return not self.overlaps and self.p_value < SIGNIFICANCE


@dataclass(frozen=True, kw_only=True)
class Scope:
    """A stage's conditions on one task, or on all of them together."""

    name: str
    tasks: int
    finals: tuple[Final, ...]
    """Of the conditions with a seed that has finished on every task in the scope."""
    compared: tuple[Final, ...]
    """Those that may be held against each other: of a search the ones on fresh seeds."""
    comparisons: tuple[Comparison, ...]
    spread: float | None
    """Standard deviation between seeds; None from single seeds."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Environment steps until a condition reaches a success rate on a task."""

    condition: Condition
    task: str
    threshold: float
    reached: int
    runs: int
    median: float
    """Infinite where fewer than half of the runs got there."""
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A metric of a condition on a task against environment steps."""

    condition: Condition
    steps: Array
    """`[points]`."""
    estimate: Estimate
    """`[points]`."""
    runs: Ints
    """`[points]`: how many runs there are that far."""


@dataclass(frozen=True, kw_only=True)
class StageAnalysis:
    """All numbers of one stage."""

    stage: Stage
    scopes: tuple[Scope, ...]
    waits: tuple[Wait, ...]
    races: tuple[Race, ...]
    """Of each pair of conditions, to each threshold."""


def analyse(sweep: Sweep, rng: np.random.Generator) -> list[StageAnalysis]:
    """The numbers of each stage."""
    return [_analyse(sweep, stage, rng) for stage in find_stages(sweep)]


def _analyse(sweep: Sweep, stage: Stage, rng: np.random.Generator) -> StageAnalysis:
    scopes = [_scope(sweep, stage, task, (task,), rng) for task in stage.tasks]
    if len(stage.tasks) > 1:
        scopes.insert(0, _scope(sweep, stage, ALL_TASKS, stage.tasks, rng))
    waits = [
        wait
        for task in stage.tasks
        for condition in stage.conditions
        for threshold in THRESHOLDS
        if (wait := _wait(sweep, condition, task, threshold, rng)) is not None
    ]
    groups = {condition.label: condition.runs for condition in stage.compared}
    found = [
        race
        for task in stage.tasks
        for threshold in THRESHOLDS
        for race in races(sweep, task, groups, threshold, rng)
    ]
    return StageAnalysis(stage=stage, scopes=tuple(scopes), waits=tuple(waits), races=tuple(found))


def analyse_stages(
    sweep: Sweep, stages: Sequence[Stage], rng: np.random.Generator
) -> StageAnalysis | None:
    """Stages that train for the task against each other, over the conditions that all have.

    Returns:
        None where there is nothing to compare.
    """
    together = stage_by_stage(sweep, stages)
    return None if together is None else _analyse(sweep, together, rng)


def _scope(
    sweep: Sweep, stage: Stage, name: str, tasks: Sequence[str], rng: np.random.Generator
) -> Scope:
    finals = []
    for condition in stage.conditions:
        scores = _final_scores(sweep, condition, tasks)
        if len(scores):
            estimate = st.estimate(scores, rng)
            finals.append(Final(condition=condition, scores=scores, estimate=estimate))
    compared = tuple(final for final in finals if final.condition in stage.compared)
    return Scope(
        name=name,
        tasks=len(tasks),
        finals=tuple(finals),
        compared=compared,
        comparisons=_comparisons(compared, rng),
        spread=st.pooled_spread([final.scores for final in finals]),
    )


def _comparisons(finals: Sequence[Final], rng: np.random.Generator) -> tuple[Comparison, ...]:
    """Each pair once, the higher q against the lower."""
    pairs = [(second, first) for first, second in combinations(finals, 2)]
    p_values = st.holm([st.improvement_p_value(a.scores, b.scores, rng) for a, b in pairs])
    return tuple(
        Comparison(
            first=a,
            second=b,
            estimate=st.probability_of_improvement(a.scores, b.scores, rng),
            p_value=p_value,
        )
        for (a, b), p_value in zip(pairs, p_values, strict=True)
    )


def _final_scores(sweep: Sweep, condition: Condition, tasks: Sequence[str]) -> Array:
    """`[seeds, T]` last success rates of finished runs.

    Seeds that have not finished on every task are left out: otherwise the task with more runs would
    weigh more in one condition than in another.
    """
    found: dict[tuple[str, int], dict[str, float]] = {}
    seen: Counter[tuple[str, str]] = Counter()
    for run in condition.runs:
        record = sweep.runs[run]
        # A condition of several q has a seed several times, in the same order on every task.
        row = (record.seed, seen[record.seed, record.task])
        seen[record.seed, record.task] += 1
        if record.task in tasks and record.status == "FINISHED":
            values = sweep.series(run, names.EVAL_SUCCESS)[1]
            if len(values) and not np.isnan(values[-1]):
                found.setdefault(row, {})[record.task] = float(values[-1])
    complete = [scores for scores in found.values() if len(scores) == len(tasks)]
    rows = [[scores[task] for task in tasks] for scores in complete]
    return np.array(rows, dtype=float).reshape(len(rows), len(tasks))


def _wait(
    sweep: Sweep, condition: Condition, task: str, threshold: float, rng: np.random.Generator
) -> Wait | None:
    passages = [
        passage
        for run in _on(sweep, condition, task)
        if (passage := first_passage(*_finite(sweep, run, names.EVAL_SUCCESS), threshold))
    ]
    if not passages:
        return None
    waits = Waits(
        steps=np.array([steps for steps, _ in passages]),
        reached=np.array([reached for _, reached in passages]),
    )
    lower, upper = median_wait_interval(waits, rng, CURVE_RESAMPLES)
    return Wait(
        condition=condition,
        task=task,
        threshold=threshold,
        reached=int(waits.reached.sum()),
        runs=len(passages),
        median=median_wait(waits),
        lower=lower,
        upper=upper,
    )


def curve(
    sweep: Sweep, condition: Condition, task: str, metric: str, rng: np.random.Generator
) -> Curve | None:
    """Interquartile mean over the runs at each step, each run as far as it went.

    Runs that were evaluated at other steps are read between their own points by straight lines,
    never before their first or after their last.

    Returns:
        None where no run has the metric.
    """
    series = [_finite(sweep, run, metric) for run in _on(sweep, condition, task)]
    series = [pair for pair in series if len(pair[0])]
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
        steps=grid,
        estimate=st.estimate(values[:, np.newaxis], rng, resamples=CURVE_RESAMPLES),
        runs=np.sum(~np.isnan(values), axis=0),
    )


def _on(sweep: Sweep, condition: Condition, task: str) -> list[int]:
    return [run for run in condition.runs if sweep.runs[run].task == task]


def _finite(sweep: Sweep, run: int, metric: str) -> tuple[Array, Array]:
    steps, values = sweep.series(run, metric)
    there = np.isfinite(values)
    return steps[there].astype(float), values[there]
