"""Steps to a threshold, which some runs never reach: a table of medians, without a test.

A run that ends below the threshold is *censored*: all that is known is that it would have taken
more than its steps. Leaving it out would make the worst setting look fast, so the median is Kaplan
and Meier's (1958), which is infinite if fewer than half of the runs reach the threshold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from music_rllib import names
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import Array

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
