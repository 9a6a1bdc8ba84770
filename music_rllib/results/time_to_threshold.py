"""Steps to a threshold, which some runs never reach, and comparisons of who reaches it sooner.

A run that ends below the threshold is *censored*: all that is known is that it would have taken
more than its steps. Leaving it out would make the worst setting look fast, so the median is Kaplan
and Meier's (1958), which is infinite where fewer than half would have got there. Where all runs end
alike, final success does not tell which of them is sooner.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE, Array, Estimate

FEWEST_FOR_INTERVAL = 5
"""Least number of runs for an interval of the median, which covers 93.75 %; of four 87.5 %."""
_COVERAGE = 0.93


@dataclass(frozen=True, kw_only=True)
class Waits:
    """Steps that each of R runs took to a threshold."""

    steps: Array
    """`[R]` environment steps to the threshold, or to the last evaluation of a run below it."""
    reached: NDArray[np.bool_]
    """`[R]`, whether the run reached the threshold; False: it is censored."""


def first_passage(steps: Array, values: Array, threshold: float) -> tuple[float, bool] | None:
    """Steps of the first evaluation with `value >= threshold`, and True.

    Args:
        steps: `[points]`, rising.
        values: `[points]`; NaN is below every threshold.
        threshold: in the unit of `values`.

    Returns:
        Steps of the last evaluation and False where none is; None for a run without evaluations.
    """
    if not len(steps):
        return None
    above = np.flatnonzero(values >= threshold)
    return (float(steps[above[0]]), True) if len(above) else (float(steps[-1]), False)


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


def median_wait(waits: Waits) -> float:
    """Steps by which half of the runs have reached the threshold.

    A run that is censored at a step at which another one arrives counts as waiting at that step.

    Returns:
        The steps; infinite where fewer than half arrive, NaN without runs.
    """
    if not len(waits.steps):
        return np.nan
    below = 1.0
    for step in np.unique(waits.steps[waits.reached]):
        waiting = np.sum(waits.steps >= step)
        arrived = np.sum((waits.steps == step) & waits.reached)
        below *= 1 - arrived / waiting
        if below <= 0.5 + 1e-12:
            return float(step)
    return np.inf


def median_wait_interval(waits: Waits) -> tuple[float, float]:
    """Interval of the median from the order of the runs, with a coverage of 93 % or more.

    Whatever the distribution, n runs are all below its median with chance 1/2^n. A censored run
    counts at its last step for the lower end and never for the upper one.

    Returns:
        Both ends; NaN for fewer than `FEWEST_FOR_INTERVAL` runs.
    """
    runs = len(waits.steps)
    outside = 2 * stats.binom.cdf(np.arange(runs), runs, 0.5)
    cut = int(np.sum(outside <= 1 - _COVERAGE)) - 1
    if cut < 0:
        return np.nan, np.nan
    soonest = np.sort(waits.steps)
    latest = np.sort(np.where(waits.reached, waits.steps, np.inf))
    return float(soonest[cut]), float(latest[runs - 1 - cut])


@dataclass(frozen=True, kw_only=True)
class Race:
    """Comparison of how soon the runs of two groups reach a success rate."""

    task: str
    threshold: float
    first: str
    second: str
    runs: tuple[int, int]
    """Number of compared runs of each group."""
    reached: bool
    """Whether any of them reached it; otherwise there is nothing to compare."""
    estimate: Estimate
    """Probability that a run of `first` is sooner than one of `second`, ties half."""
    p_value: float
    """p-value of the permutation test, with Holm's correction over the task's pairs that reached
    this threshold."""

    @property
    def decided(self) -> bool:
        """Whether so large a difference seldom comes by chance."""
        return self.p_value < SIGNIFICANCE


def races(
    sweep: Sweep, task: str, groups: Mapping[str, Sequence[int]], threshold: float
) -> tuple[Race, ...]:
    """Comparison of each pair of groups, a later group against an earlier one.

    A run that ended below the threshold is later than every run that reached it, and ties with the
    others that did not. Runs of another length count as if all had the smaller budget of the two
    groups. A run that is not finished is left out, also where it has arrived: of runs that were
    stopped early only the quick ones have.

    Args:
        sweep: the runs.
        task: task of the runs that are compared.
        groups: name to positions in `sweep.runs`.
        threshold: success rate at the last step of evaluation episodes.
    """
    finished = {
        name: [run for run in runs if sweep.runs[run].task == task and sweep.runs[run].is_finished]
        for name, runs in groups.items()
    }
    pairs = []
    for first, second in combinations(groups, 2):
        sides = (finished[second], finished[first])
        budget = sweep.least_end(task, [*sides[0], *sides[1]])
        x, y = (_earliness(sweep, task, runs, threshold, budget) for runs in sides)
        if len(x) and len(y):
            pairs.append((second, first, x, y, bool(np.isfinite([*x, *y]).any())))
    # A pair without a run that reached the threshold could not have come out otherwise: no test.
    p_values = [st.improvement_p_value(x, y) for _, _, x, y, reached in pairs if reached]
    adjusted = iter(st.holm(p_values))
    return tuple(
        Race(
            task=task,
            threshold=threshold,
            first=a,
            second=b,
            runs=(len(x), len(y)),
            reached=reached,
            estimate=st.probability_of_improvement(x, y),
            p_value=next(adjusted) if reached else 1.0,
        )
        for a, b, x, y, reached in pairs
    )


def _earliness(
    sweep: Sweep, task: str, runs: Sequence[int], threshold: float, budget: float
) -> Array:
    """Minus the steps to the threshold, `[R, 1]`; minus infinity for runs below it at `budget`."""
    earliness = [
        -steps if reached and steps <= budget else -np.inf
        for steps, reached in _passages(sweep, task, runs, threshold)
    ]
    return np.array(earliness, dtype=float).reshape(-1, 1)
