"""Final values of conditions: means with intervals, and differences without a test.

`compare`, the report, its tables and the results page all go through :func:`scopes_of`, so that
they have the same numbers. Verdicts come from :mod:`music_rllib.results.claims` alone.


Steps to a threshold, which some runs never reach: a table of medians, without a test.

A run that ends below the threshold is *censored*: all that is known is that it would have taken
more than its steps. Leaving it out would make the worst setting look fast, so the median is Kaplan
and Meier's (1958), which is infinite if fewer than half of the runs reach the threshold.


Statistics of every stage of a sweep, on each of its tasks.

A final score is the primary metric of a finished run's last evaluation. Curves and steps to a
threshold take every run as far as it went: one that failed or is still running is censored there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.conditions import (
    ALL_TASKS,
    AVERAGED,
    Condition,
    Stage,
    final_scores,
    find_stages,
    stage_by_stage,
)
from music_rllib.results.data import Ints, Sweep
from music_rllib.results.statistics import (
    SHOW_SEEDS_BELOW,
    Array,
    Estimate,
    Waits,
    first_passage,
    median_wait,
    median_wait_interval,
)


class Labelled(Protocol):
    """A condition with a label."""

    @property
    def label(self) -> str: ...


C = TypeVar("C", bound=Labelled)


@dataclass(frozen=True, kw_only=True, eq=False)
class Final(Generic[C]):
    """Final scores of a condition."""

    condition: C
    scores: Array = field(repr=False)
    """`[seeds, T]`, of the seeds that have finished on every task of the scope."""
    estimate: Estimate

    @property
    def value(self) -> float:
        return float(self.estimate.value)

    @property
    def runs(self) -> int:
        return int(self.scores.size)

    @property
    def seeds(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison(Generic[C]):
    """Comparison of the final scores of two conditions."""

    first: Final[C]
    second: Final[C]
    improvement: float
    """Probability that a run of `first` ends higher than one of `second`, ties half."""

    @property
    def gap(self) -> Estimate:
        """Mean of `first` minus that of `second`."""
        return st.difference(self.first.estimate, self.second.estimate)


@dataclass(frozen=True, kw_only=True)
class Scope(Generic[C]):
    """Conditions on one task, or on all tasks together."""

    name: str
    """The task, or `ALL_TASKS`."""
    metric: str
    """Metric whose last value is the score."""
    tasks: int
    finals: tuple[Final[C], ...]
    """Scores of the conditions with a seed that has finished on every task of the scope."""
    compared: tuple[Final[C], ...]
    """Scores of those that may be compared: of a search, conditions on fresh seeds."""
    comparisons: tuple[Comparison[C], ...]
    """Comparison of each pair of `compared`, a later condition against an earlier one."""


def scopes_of(
    metrics: Mapping[str, str],
    conditions: Sequence[tuple[C, Array, float]],
    may_be_compared: Collection[C],
) -> tuple[Scope[C], ...]:
    """A scope for each task, after one over all tasks where these have a unit in common.

    Args:
        metrics: task to the metric of its scores, for T tasks.
        conditions: each with its scores `[seeds, T]`, NaN for what has not finished, and its
            evaluation episodes, infinite where they are not known. Seeds that have not finished on
            every task of a scope are left out of it: otherwise a task could weigh more in one
            condition than in another.
        may_be_compared: conditions that are compared with each other.
    """
    columns = [(task, metric, [column]) for column, (task, metric) in enumerate(metrics.items())]
    if len(columns) > 1 and len(set(metrics.values())) == 1 and columns[0][1] in AVERAGED:
        columns.insert(0, (ALL_TASKS, columns[0][1], list(range(len(columns)))))
    return tuple(
        _scope(name, metric, [(c, x[:, chosen], n) for c, x, n in conditions], may_be_compared)
        for name, metric, chosen in columns
    )


def _scope(
    name: str,
    metric: str,
    conditions: Sequence[tuple[C, Array, float]],
    may_be_compared: Collection[C],
) -> Scope[C]:
    is_rate = metric in names.EVAL_RATES
    finals = [
        Final(
            condition=condition,
            scores=complete,
            estimate=st.estimate(complete, episodes if is_rate else None),
        )
        for condition, scores, episodes in conditions
        if len(complete := scores[~np.isnan(scores).any(axis=1)])
    ]
    compared = tuple(final for final in finals if final.condition in may_be_compared)
    pairs = [(second, first) for first, second in combinations(compared, 2)]
    return Scope(
        name=name,
        metric=metric,
        tasks=conditions[0][1].shape[1] if conditions else 1,
        finals=tuple(finals),
        compared=compared,
        comparisons=tuple(
            Comparison(first=a, second=b, improvement=st.improvement(a.scores, b.scores))
            for a, b in pairs
        ),
    )


def each_seed(final: Final[C]) -> list[float]:
    """Rising scores of the seeds, means over the tasks; empty where there are many seeds."""
    return sorted(final.scores.mean(axis=1).tolist()) if final.seeds < SHOW_SEEDS_BELOW else []


def waits_of(sweep: Sweep, task: str, runs: Sequence[int], threshold: float) -> Waits | None:
    """Steps of a task's runs to a success rate; None where none was evaluated."""
    passages = list(_passages(sweep, task, runs, threshold))
    if not passages:
        return None
    steps, reached = zip(*passages, strict=True)
    return Waits(steps=np.array(steps), reached=np.array(reached))


def _passages(
    sweep: Sweep, task: str, runs: Sequence[int], threshold: float
) -> Iterator[tuple[float, bool]]:
    """:func:`first_passage` of each run on a task that was evaluated."""
    for run in runs:
        if sweep.runs[run].task == task:
            passage = first_passage(*sweep.finite(run, names.EVAL_SUCCESS), threshold)
            if passage is not None:
                yield passage


THRESHOLDS = (0.5, 0.85)
"""Success rates that steps are counted to; the paper's Figure 4 has 85 %."""
CURVE_POINTS = 101
"""Largest number of points of a curve; more cannot be told apart in a figure."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Environment steps until a condition reaches a success rate on a task."""

    condition: Condition
    task: str
    threshold: float
    waits: Waits
    median: float
    """Median over the runs; infinite where fewer than half of them reached the rate."""
    lower: float
    """Lower end of its interval; NaN, as `upper`, where there are too few runs."""
    upper: float

    @property
    def runs(self) -> int:
        return len(self.waits.steps)

    @property
    def reached(self) -> int:
        return int(self.waits.reached.sum())


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Learning curve of a condition on a task."""

    condition: Condition
    task: str
    steps: Array
    """`[points]` environment steps."""
    values: Array
    """`[R, points]` of a metric, NaN before a run's first and after its last evaluation."""
    estimate: Estimate
    """`[points]`, mean over the runs."""
    runs: Ints
    """`[points]`, number of runs that have a value."""


class Entropies(NamedTuple):
    """Entropies of a condition's policies at the end, means over finished runs; None without one.

    S_q has the run's own q and form, so that its values at different q are not to be compared.
    """

    shannon: Estimate | None
    """In nats, over all action dimensions."""
    tsallis: Estimate | None

    @property
    def numbers(self) -> list[float]:
        """Mean and both ends of the interval of each entropy; NaN where there is none."""
        triples = ((one.value, one.lower, one.upper) if one else (np.nan,) * 3 for one in self)
        return [float(number) for triple in triples for number in triple]


@dataclass(frozen=True, kw_only=True)
class StageAnalysis:
    """Statistics of one stage."""

    stage: Stage
    scopes: tuple[Scope[Condition], ...]
    waits: tuple[Wait, ...]
    entropies: Mapping[tuple[str, Condition], Entropies]
    """Entropies by scope and condition."""
    cut_at: Mapping[str, float]
    """Environment steps at which final scores were read on a task; without tasks on which they are
    those of the runs' ends."""


def analyse(sweep: Sweep) -> list[StageAnalysis]:
    """The statistics of each stage."""
    return [_analyse(sweep, stage) for stage in find_stages(sweep)]


def _analyse(
    sweep: Sweep, stage: Stage, cut_at: Mapping[str, float] | None = None
) -> StageAnalysis:
    cut_at = cut_at or {}
    ended = sweep.until(cut_at) if cut_at else sweep
    metrics = {task: sweep.primary_metric(task) for task in stage.tasks}
    scopes = stage_scopes(ended, stage)
    cells = [
        (task, threshold)
        for task, metric in metrics.items()
        if metric == names.EVAL_SUCCESS
        for threshold in THRESHOLDS
    ]
    return StageAnalysis(
        stage=stage,
        scopes=scopes,
        waits=tuple(
            wait for task, threshold in cells for wait in _waits(sweep, stage, task, threshold)
        ),
        entropies={
            (scope.name, final.condition): _entropies(ended, final.condition, stage, scope.name)
            for scope in scopes
            for final in scope.finals
        },
        cut_at=cut_at,
    )


def stage_scopes(
    sweep: Sweep, stage: Stage, metric: str | None = None
) -> tuple[Scope[Condition], ...]:
    """Comparisons of a stage's conditions by the last values of a metric.

    Without `metric`, by each task's primary one.
    """
    metrics = {task: metric or sweep.primary_metric(task) for task in stage.tasks}
    scored = [
        (condition, final_scores(sweep, condition, metrics), sweep.episodes(condition.runs))
        for condition in stage.conditions
    ]
    return scopes_of(metrics, scored, stage.compared)


def _entropies(sweep: Sweep, condition: Condition, stage: Stage, scope: str) -> Entropies:
    tasks = stage.tasks if scope == ALL_TASKS else (scope,)
    runs = tuple(run for run in condition.runs if sweep.runs[run].task in tasks)
    estimates = []
    for metric in (names.SHANNON_ENTROPY, names.ENTROPY):
        scores = final_scores(sweep, replace(condition, runs=runs), dict.fromkeys(tasks, metric))
        complete = scores[~np.isnan(scores).any(axis=1)]
        estimates.append(st.estimate(complete) if len(complete) else None)
    return Entropies(*estimates)


def analyse_stages(sweep: Sweep, stages: Sequence[Stage]) -> StageAnalysis | None:
    """Stages compared with each other (:func:`stage_by_stage`); None where there is nothing to.

    Where one has a smaller budget on a task, the others are read at its end.
    """
    together = stage_by_stage(sweep, stages)
    if together is None:
        return None
    cut_at = {}
    for task in together.tasks:
        budgets = {sweep.least_budget(task, one.runs) for one in together.compared}
        if len([budget for budget in budgets if np.isfinite(budget)]) > 1:
            cut_at[task] = min(sweep.least_end(task, one.runs) for one in together.compared)
    return _analyse(sweep, together, cut_at)


def _waits(sweep: Sweep, stage: Stage, task: str, threshold: float) -> Iterator[Wait]:
    for condition in stage.conditions:
        waits = waits_of(sweep, task, condition.runs, threshold)
        if waits is not None:
            lower, upper = median_wait_interval(waits)
            yield Wait(
                condition=condition,
                task=task,
                threshold=threshold,
                waits=waits,
                median=median_wait(waits),
                lower=lower,
                upper=upper,
            )


def curve(sweep: Sweep, condition: Condition, task: str, metric: str) -> Curve | None:
    """Learning curve of a condition on a task; None where no run has the metric.

    Where a run was not evaluated at a step of the others, its value lies on the straight line
    between its own evaluations; before the first and after the last of them it has none.
    """
    runs = [run for run in condition.runs if sweep.runs[run].task == task]
    series = [pair for run in runs if len((pair := sweep.finite(run, metric))[0])]
    if not series:
        return None
    grid = np.unique(np.concatenate([steps for steps, _ in series]))
    if len(grid) > CURVE_POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, CURVE_POINTS).round().astype(int)]
    values = np.stack(
        [np.interp(grid, steps, own, left=np.nan, right=np.nan) for steps, own in series]
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
