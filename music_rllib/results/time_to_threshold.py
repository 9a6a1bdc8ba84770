"""Steps to a threshold, where some runs never get there, and who gets there sooner.

A run that ends below the threshold is *censored*: all that is known is that it would have taken
more than its steps. Leaving it out would make the worst setting look fast, so the median is Kaplan
and Meier's (1958), which is infinite where fewer than half would have got there. Final success says
nothing of who is sooner where all end alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from music_rllib import names
from music_rllib.results import statistics as st
from music_rllib.results.data import Sweep
from music_rllib.results.statistics import SIGNIFICANCE, Array, Estimate

__all__ = [
    "FEWEST_FOR_INTERVAL",
    "Race",
    "Waits",
    "first_passage",
    "median_wait",
    "median_wait_interval",
    "races",
    "waits_of",
]

FEWEST_FOR_INTERVAL = 5
"""For an interval of the median: with five runs it covers 93.75 %, with four 87.5 %."""
_COVERAGE = 0.93


@dataclass(frozen=True, kw_only=True)
class Waits:
    """How long each of R runs took."""

    steps: Array
    """`[R]` environment steps: to the threshold, or to the run's last evaluation."""
    reached: NDArray[np.bool_]
    """`[R]`; False: censored."""


def first_passage(steps: Array, values: Array, threshold: float) -> tuple[float, bool] | None:
    """Steps of the first evaluation with `value >= threshold`, or of the last one with False.

    Args:
        steps: `[points]`, rising.
        values: `[points]`; NaN never reaches anything.
        threshold: in the values' unit.

    Returns:
        None for a run that was never evaluated.
    """
    if not len(steps):
        return None
    there = np.flatnonzero(values >= threshold)
    return (float(steps[there[0]]), True) if len(there) else (float(steps[-1]), False)


def waits_of(sweep: Sweep, task: str, runs: Sequence[int], threshold: float) -> Waits | None:
    """How long the runs of a task took to a success rate; None where none was evaluated."""
    passages = [
        passage
        for run in runs
        if sweep.runs[run].task == task
        and (passage := first_passage(*sweep.finite(run, names.EVAL_SUCCESS), threshold))
    ]
    if not passages:
        return None
    steps, reached = zip(*passages, strict=True)
    return Waits(steps=np.array(steps), reached=np.array(reached))


def median_wait(waits: Waits) -> float:
    """First number of steps by which half the runs are there; infinite where that is not known.

    NaN without runs. Where a run is censored at the same step at which another gets there, it
    counts as still waiting at that step.
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
    """Interval of the median by the runs' order alone, which covers 93 % or more.

    Whatever the distribution, n runs are all below its median with chance 1/2^n. A censored run
    counts at its last step for the lower end and never for the upper one.

    Returns:
        NaN from fewer than `FEWEST_FOR_INTERVAL`, of which not even the outermost cover.
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
    """Whether runs of one group get to a success rate before those of another."""

    task: str
    threshold: float
    first: str
    second: str
    runs: tuple[int, int]
    """How many of either group are compared."""
    reached: bool
    """Whether any of them got there; otherwise there is nothing to compare."""
    estimate: Estimate
    """Probability that a run of `first` is there before one of `second`, ties half."""
    p_value: float
    """Of the permutation test, adjusted for the task's other pairs at this threshold (Holm)."""

    @property
    def decided(self) -> bool:
        """Whether so large a difference seldom comes by chance."""
        return self.p_value < SIGNIFICANCE


def races(
    sweep: Sweep, task: str, groups: Mapping[str, Sequence[int]], threshold: float
) -> tuple[Race, ...]:
    """Every pair of groups once, a later group against an earlier one.

    A run that has used up its budget without getting there is later than every one that has got
    there, and as late as another that has not.

    Args:
        sweep: the runs.
        task: whose runs are compared.
        groups: name to positions in `sweep.runs`.
        threshold: success rate at the last step of evaluation episodes.
    """
    found = {name: _earliness(sweep, task, runs, threshold) for name, runs in groups.items()}
    there = [name for name in groups if len(found[name])]
    pairs = [(second, first) for first, second in combinations(there, 2)]
    reached = [bool(np.isfinite(np.concatenate([found[a], found[b]])).any()) for a, b in pairs]
    raw = [st.improvement_p_value(found[a], found[b]) for a, b in pairs]
    # A pair of which nobody got there is no test that could have come out otherwise.
    adjusted = iter(st.holm([p for p, any_ in zip(raw, reached, strict=True) if any_]))
    return tuple(
        Race(
            task=task,
            threshold=threshold,
            first=a,
            second=b,
            runs=(len(found[a]), len(found[b])),
            reached=any_,
            estimate=st.probability_of_improvement(found[a], found[b]),
            p_value=next(adjusted) if any_ else 1.0,
        )
        for (a, b), any_ in zip(pairs, reached, strict=True)
    )


def _earliness(sweep: Sweep, task: str, runs: Sequence[int], threshold: float) -> Array:
    """`[R, 1]` minus the steps to the threshold, minus infinity for runs that ended below it.

    A run that is not finished and not there yet could still be the sooner one: it is left out.
    """
    earliness = []
    for run in runs:
        passage = first_passage(*sweep.finite(run, names.EVAL_SUCCESS), threshold)
        if sweep.runs[run].task != task or passage is None:
            continue
        if passage[1]:
            earliness.append(-passage[0])
        elif sweep.runs[run].status == "FINISHED":
            earliness.append(-np.inf)
    return np.array(earliness, dtype=float).reshape(-1, 1)
