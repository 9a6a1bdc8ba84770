"""Steps to a threshold, where some runs never get there.

A run that ends below the threshold is *censored*: all that is known is that it would have taken
more than its steps. Leaving it out would make the worst setting look fast, so the median is Kaplan
and Meier's (1958), which is infinite where fewer than half would have got there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from music_rllib.results.statistics import CONFIDENCE, RESAMPLES, Array

__all__ = ["Waits", "first_passage", "median_wait", "median_wait_interval"]


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


def median_wait_interval(
    waits: Waits, rng: np.random.Generator, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """95 % percentile-bootstrap interval of :func:`median_wait`; NaN from fewer than two runs.

    The ends are values that were drawn, since between a number and infinity there is no mean.
    """
    runs = len(waits.steps)
    if runs < 2:
        return np.nan, np.nan
    drawn = _medians(waits, rng.integers(runs, size=(resamples, runs)))
    tail = (1 - CONFIDENCE) / 2
    lower, upper = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return float(lower), float(upper)


def _medians(waits: Waits, chosen: NDArray[np.int64]) -> Array:
    """`[S]` the median wait of each sample: `[S, R]` runs, drawn with replacement."""
    steps, position = np.unique(waits.steps, return_inverse=True)
    there, samples = np.zeros((len(chosen), len(steps))), np.arange(len(chosen))[:, np.newaxis]
    everyone = there.copy()
    np.add.at(everyone, (samples, position[chosen]), 1)
    np.add.at(there, (samples, position[chosen]), waits.reached[chosen])
    waiting = everyone[:, ::-1].cumsum(1)[:, ::-1]
    below = np.cumprod(1 - there / np.maximum(waiting, 1), axis=1)
    passed = (below <= 0.5 + 1e-12) & (there > 0)
    return np.where(passed.any(1), steps[passed.argmax(1)], np.inf)
