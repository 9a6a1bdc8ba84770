"""Final values, times to a threshold and learning curves of every stage, on each of its tasks.

These are tables and figures without a test; verdicts come from :mod:`music_rllib.results.study`.
Final values are the last evaluations of finished runs. Curves and times to a threshold use all
evaluations of every run; a run that failed or is still running is censored at its last one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.conditions import (
    ALL_TASKS,
    ALPHA,
    AVERAGED,
    Condition,
    StageRuns,
    find_stages,
)
from music_rllib.results.data import Ints, RunRecord, Sweep
from music_rllib.results.statistics import Array, Estimate
from music_rllib.results.study import Mean

THRESHOLDS = (0.5, 0.85)
"""Success rates of the times to a threshold; the paper's Figure 4 uses 85%."""
CURVE_POINTS = 101
"""Largest number of points of a curve in a figure."""
RATE_LIMITS = (-0.03, 1.03)
"""Ends of an axis for rates."""


@dataclass(frozen=True)
class Metric:
    """A metric that has learning curves."""

    name: str
    title: str
    axis: str
    """Label of the axis, with the unit."""
    limits: tuple[float, float] | None = None
    target: float | None = None


METRICS = (
    Metric(names.EVAL_SUCCESS, "Success rate", "success rate", RATE_LIMITS, THRESHOLDS[1]),
    Metric(names.EVAL_RETURN, "Return", "return of an episode"),
    Metric(names.EVAL_SUCCESS_ANY, "Success at any step", "success at any step", RATE_LIMITS),
    Metric(names.EVAL_DISPLACEMENT, "Object displacement", "object displacement (m)"),
    Metric(names.MI_BOUND, "Mutual-information bound", "MI bound (nats)"),
    Metric(names.MI_REWARD, "Mutual-information reward", "MI reward per step"),
    Metric(names.ENTROPY, "Tsallis entropy of the policy", "Tsallis entropy"),
    Metric(names.SHANNON_ENTROPY, "Shannon entropy of the policy", "Shannon entropy (nats)"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class FinalScores:
    """Final scores of a condition."""

    condition: Condition
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


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Conditions on one task, or on all tasks together."""

    name: str
    """The task, or `ALL_TASKS`."""
    metric: str
    """Metric whose last value is the score."""
    finals: tuple[FinalScores, ...]
    """Scores of the conditions that have a seed which has finished on every task of the scope."""
    compared: tuple[FinalScores, ...]
    """Scores of the conditions that may be compared: in a search, those on fresh seeds."""


@dataclass(frozen=True, kw_only=True)
class TimeToThreshold:
    """Environment steps until the R runs of a condition reach a success rate on a task."""

    condition: Condition
    task: str
    threshold: float
    steps: Array
    """`[R]` environment steps to the threshold, or to the last evaluation of a censored run."""
    reached: NDArray[np.bool_]
    """`[R]`, whether the run reached the threshold; False: the run is censored."""
    median: Estimate
    """Infinite if fewer than half of the runs reached the threshold."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Learning curve of a condition on a task."""

    condition: Condition
    task: str
    steps: Array
    values: Array
    """`[R, points]` of a metric, NaN before a run's first and after its last evaluation."""
    estimate: Estimate
    """`[points]`, mean over the runs."""
    runs: Ints
    """`[points]`, number of runs that have a value."""


class Entropies(NamedTuple):
    """Final entropies of a condition's policies, means over finished runs; None without one.

    S_q depends on the run's own q and form: values at different q are not comparable.
    """

    shannon: Estimate | None
    """In nats, over all action dimensions."""
    tsallis: Estimate | None


@dataclass(frozen=True, kw_only=True)
class StageAnalysis:
    """Statistics of one stage."""

    stage: StageRuns
    scopes: tuple[Scope, ...]
    times: tuple[TimeToThreshold, ...]
    entropies: Mapping[tuple[str, Condition], Entropies]


def analyse(sweep: Sweep) -> list[StageAnalysis]:
    """Compute the statistics of each stage."""
    return [analyse_stage(sweep, stage) for stage in find_stages(sweep)]


def analyse_stage(sweep: Sweep, stage: StageRuns, metric: str | None = None) -> StageAnalysis:
    """Compute the statistics of one stage.

    Its final values are those of `metric`; None: of each task's primary one.
    """
    scopes = stage_scopes(sweep, stage, metric)
    rated = [task for task in stage.tasks if sweep.primary_metric(task) == names.EVAL_SUCCESS]
    times = (
        time_to_threshold(sweep, condition, task, threshold)
        for task in rated
        for threshold in THRESHOLDS
        for condition in stage.conditions
    )
    estimates = [
        {
            (scope.name, final.condition): final.estimate
            for scope in stage_scopes(sweep, stage, entropy)
            for final in scope.finals
        }
        for entropy in names.ENTROPIES
    ]
    conditions = ((scope.name, final.condition) for scope in scopes for final in scope.finals)
    return StageAnalysis(
        stage=stage,
        scopes=scopes,
        times=tuple(one for one in times if one is not None),
        entropies={key: Entropies(*(of.get(key) for of in estimates)) for key in conditions},
    )


def stage_scopes(sweep: Sweep, stage: StageRuns, metric: str | None = None) -> tuple[Scope, ...]:
    """Final values of a stage's conditions: a scope for each task.

    The first scope covers all tasks if their metric has the same unit. If `metric` is None, it is
    each task's primary one.
    """
    metrics = {task: metric or sweep.primary_metric(task) for task in stage.tasks}
    parts = {task: {task: own} for task, own in metrics.items()}
    if len(metrics) > 1 and len(set(metrics.values())) == 1 and {*metrics.values()} <= AVERAGED:
        parts = {ALL_TASKS: metrics, **parts}
    scopes = []
    for name, own in parts.items():
        found = [_final(sweep, condition, own) for condition in stage.conditions]
        finals = tuple(final for final in found if final is not None)
        compared = tuple(final for final in finals if final.condition in stage.compared)
        metric = next(iter(own.values()))
        scopes.append(Scope(name=name, metric=metric, finals=finals, compared=compared))
    return tuple(scopes)


def _final(sweep: Sweep, condition: Condition, metrics: Mapping[str, str]) -> FinalScores | None:
    """Last values of a condition's finished runs, by the metric of each task; None without any.

    A seed that has not finished on every task is left out; otherwise tasks would have unequal
    weights.
    """
    by_seed: defaultdict[str, dict[str, float]] = defaultdict(dict)
    for run in condition.runs:
        record = sweep.runs[run]
        metric = metrics.get(record.task)
        if metric and record.is_finished and (score := sweep.final(run, metric)) is not None:
            by_seed[record.seed][record.task] = score
    complete = [own for own in by_seed.values() if own.keys() == metrics.keys()]
    if not complete:
        return None
    scores = np.array([[own[task] for task in metrics] for own in complete])
    is_rate = {*metrics.values()} <= names.EVAL_RATES
    own_runs = [run for run in condition.runs if sweep.runs[run].task in metrics]
    estimate = st.estimate(scores, sweep.episodes(own_runs) if is_rate else None)
    return FinalScores(condition=condition, scores=scores, estimate=estimate)


def time_to_threshold(
    sweep: Sweep, condition: Condition, task: str, threshold: float
) -> TimeToThreshold | None:
    """Environment steps of a condition's runs to a success rate; None if none was evaluated."""
    runs = (run for run in condition.runs if sweep.runs[run].task == task)
    series = (sweep.finite(run, names.EVAL_SUCCESS) for run in runs)
    passages = [p for one in series if (p := st.first_passage(*one, threshold)) is not None]
    if not passages:
        return None
    steps, reached = map(np.array, zip(*passages, strict=True))
    return TimeToThreshold(
        condition=condition,
        task=task,
        threshold=threshold,
        steps=steps,
        reached=reached,
        median=st.censored_median(steps, reached),
    )


def curve(sweep: Sweep, condition: Condition, task: str, metric: str) -> Curve | None:
    """Learning curve of a condition on a task; None if no run has the metric.

    A run that was not evaluated at a step of the other runs is interpolated linearly between its
    own evaluations. It has no value before the first and after the last of them.
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
    episodes = sweep.episodes(runs) if metric in names.EVAL_RATES else None
    return Curve(
        condition=condition,
        task=task,
        steps=grid,
        values=values,
        estimate=st.estimate(values[:, np.newaxis], episodes),
        runs=np.sum(~np.isnan(values), axis=0),
    )


_SHOWN = 10
"""Largest number of runs in a sentence."""


def mixed(runs: Iterable[RunRecord], label: Callable[[str], str] = str) -> Iterator[str]:
    """A line for each task whose finished runs used several versions of its environment."""
    tasks: dict[str, dict[str, list[str]]] = {}
    for run in runs:
        if run.is_finished and (digest := run.tags.get(names.TAG_ENVIRONMENT)):
            tasks.setdefault(run.task, {}).setdefault(digest, []).append(label(run.name))
    for task, groups in tasks.items():
        if len(groups) > 1:
            parts = (
                f"{', '.join(runs_of[:_SHOWN])}{' ...' * (len(runs_of) > _SHOWN)} ({digest[:6]})"
                for digest, runs_of in groups.items()
            )
            yield (
                f"Runs on {task} are compared that used {len(groups)} versions of its environment: "
                f"{'; '.join(parts)}."
            )


# Sensitivity to α ---------------------------------------------------------------------------------

AlphaLine = Sequence[tuple[float, Mean]]
"""Values of α in increasing order, with the mean scores of conditions that differ only in α."""


def alpha_lines(means: Sequence[Mean]) -> list[AlphaLine]:
    """Lines with at least two values of α; conditions whose α is not a number are left out."""
    groups: defaultdict[tuple[object, ...], list[tuple[float, Mean]]] = defaultdict(list)
    for mean in means:
        settings = dict(mean.condition.others)
        with suppress(ValueError):
            alpha = float(settings.pop(ALPHA, ""))
            key = (mean.task, mean.condition.entropic_index, *settings.items())
            groups[key].append((alpha, mean))
    return [sorted(line, key=lambda point: point[0]) for line in groups.values() if len(line) > 1]
