"""Statistics of few seeds: estimates with calibrated intervals, and the number of seeds needed.

Shapes: R runs (seeds) of one condition on each of T tasks. `scores` is `[R, T]` or, for curves,
`[R, T, points]`. NaN marks a missing run, so tasks may have different numbers of runs. All
functions are deterministic.

The estimate is the mean over each task's runs, then over the tasks. The interquartile mean of
Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264) is not used: below ten seeds it estimates a
different quantity for each number of seeds and ignores the seed that failed, and with three seeds
its 95% percentile bootstrap covers 74%. `tests/unit/results/test_coverage.py` simulates the
coverage of the intervals here; docs/reports.md lists it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Bit for bit the values of scipy.stats (bdtr to 1e-15), whose import takes 0.5 s and 50 MB.
from scipy.special import bdtr, betaincinv, nctdtr, ndtri, stdtrit

Array = NDArray[np.float64]

SIGNIFICANCE = 0.05
POWER = 0.8
"""Probability of detecting a difference for which seeds are planned."""
MAX_SEEDS = 1000
"""Largest number of seeds that is tried when planning."""
IMPORTANCE_TRIALS = 10
"""Complete trials that an estimate of the settings' importance needs."""
SHOW_SEEDS_BELOW = 10
"""Number of seeds from which on single seeds are not listed."""
FEWEST_FOR_INTERVAL = 5
"""Smallest number of runs for an interval of a median: its coverage is 93.75%, with four 87.5%."""
_TAIL = 0.025
"""Probability on either side of a 95% interval."""
_COVERAGE = 0.93
"""Smallest coverage of the interval of a median."""
_NO_SPREAD = 1e-12
"""Variances below it are rounding errors: the seeds tie."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A value with its 95% interval, each of the shape of the estimated quantity."""

    value: Array
    lower: Array
    upper: Array

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Value and ends of a single estimate."""
        return float(self.value), float(self.lower), float(self.upper)

    @property
    def has_interval(self) -> bool:
        return bool(np.all(np.isfinite(self.lower) & np.isfinite(self.upper)))


def estimate(scores: Array, episodes: float | None = None) -> Estimate:
    """Mean over the runs of each task and then over the tasks, with its 95% interval.

    Tasks are strata: only the spread between runs of the same task counts. The pooled variance has
    Welch-Satterthwaite degrees of freedom. :func:`interval_of_mean` computes the interval.

    Args:
        scores: `[R, T]` or `[R, T, points]`.
        episodes: Number of evaluation episodes behind each score of a rate, infinite if unknown;
            None for a metric that is not a rate.

    Returns:
        Scalars, or `[points]`. The interval is NaN if a task has fewer than two runs.
    """
    runs = np.sum(~np.isnan(scores), axis=0)
    of_task = _ratio(np.nansum(scores, axis=0), runs)
    squares = np.nansum((scores - of_task) ** 2, axis=0)
    parts = _ratio(squares, (runs - 1) * runs)
    parts[runs < 2] = np.nan
    tasks = scores.shape[1]
    variance = parts.sum(axis=0)
    tied = variance < _NO_SPREAD
    freedom = _ratio(variance**2, _ratio(parts**2, runs - 1).sum(axis=0))
    freedom = np.where(tied, np.sum(runs - 1, axis=0), freedom)
    return interval_of_mean(
        of_task.mean(axis=0),
        variance / tasks**2,
        freedom,
        None if episodes is None else episodes * runs.sum(axis=0),
    )


def interval_of_mean(
    value: ArrayLike, variance: ArrayLike, freedom: ArrayLike, episodes: ArrayLike | None = None
) -> Estimate:
    """95% interval around an estimated mean of few runs.

    An unbounded metric has Student's interval. A rate has the interval of Korn and Graubard (1998,
    Survey Methodology 24, 193-201), the standard for proportions from clusters. This is the
    Clopper-Pearson interval with the number of independent episodes that would give the same
    variance, reduced for the few degrees of freedom. It stays within [0, 1] and is longer on the
    side away from a bound. If all runs tie, it is the exact interval over their episodes.

    Args:
        variance: Variance of the mean.
        freedom: Degrees of freedom of `variance`; 0 or NaN: no interval.
        episodes: Number of all episodes behind a rate; None for a metric that is not a rate.

    Returns:
        The interval; NaN also if the runs tie and the number of episodes is unknown.
    """
    value, variance, freedom = (
        np.asarray(part, dtype=float) for part in np.broadcast_arrays(value, variance, freedom)
    )
    t = stdtrit(np.where(freedom > 0, freedom, np.nan), 1 - _TAIL)
    tied = variance < _NO_SPREAD
    if episodes is None:
        half = np.where(tied, np.nan, t * np.sqrt(variance))
        return Estimate(value=value, lower=value - half, upper=value + half)
    alike = _ratio(value * (1 - value), np.where(tied, np.nan, variance))
    lessened = np.minimum(alike, episodes) * (ndtri(1 - _TAIL) / t) ** 2
    trials = np.where(tied & ~np.isnan(t), episodes, lessened)
    lower, upper = clopper_pearson(value, trials)
    return Estimate(value=value, lower=lower, upper=upper)


def clopper_pearson(share: ArrayLike, trials: ArrayLike) -> tuple[Array, Array]:
    """Exact 95% interval of a probability (Clopper and Pearson 1934).

    Args:
        share: Share of successes.
        trials: Number of trials, not necessarily an integer; NaN or infinite: no interval.
    """
    share, trials = (np.asarray(part, float) for part in np.broadcast_arrays(share, trials))
    trials = np.where(np.isfinite(trials), trials, np.nan)
    won, lost = share * trials, (1 - share) * trials
    lower = np.where(won > 0, betaincinv(won, lost + 1, _TAIL), 0 * trials)
    upper = np.where(lost > 0, betaincinv(won + 1, lost, 1 - _TAIL), 1 + 0 * trials)
    return lower, upper


def difference(x: Estimate, y: Estimate) -> Estimate:
    """`x - y` of independent estimates, with an interval made from theirs.

    The method of variance estimates recovery (Zou and Donner 2008) keeps their asymmetry.
    """
    value = x.value - y.value
    return Estimate(
        value=value,
        lower=value - np.hypot(x.value - x.lower, y.upper - y.value),
        upper=value + np.hypot(x.upper - x.value, y.value - y.lower),
    )


def performance_profile(scores: Array, thresholds: Array) -> Estimate:
    """`[R, T]`, `[points]` -> `[points]` share of runs with a score above each threshold.

    It is the run-score distribution of rliable, with the exact interval of each share.
    """
    there = scores[~np.isnan(scores)]
    above = np.mean(there[:, np.newaxis] > thresholds, axis=0)
    lower, upper = clopper_pearson(above, len(there))
    return Estimate(value=above, lower=lower, upper=upper)


def improvement(x: Array, y: Array) -> float:
    """P(a run of x scores higher than a run of y), ties counted half, averaged over tasks.

    Args:
        x: `[Rx, T]`, with a run of every task.
        y: `[Ry, T]`, for the same tasks.
    """
    shares = []
    for first, second in zip(x.T, y.T, strict=True):
        a, b = first[~np.isnan(first), np.newaxis], second[~np.isnan(second)]
        shares.append(np.mean((a > b) + 0.5 * (a == b)))
    return float(np.mean(shares))


# Times to a threshold -----------------------------------------------------------------------------


def first_passage(steps: Array, values: Array, threshold: float) -> tuple[float, bool] | None:
    """Steps of the first evaluation with `value >= threshold`, and True.

    Args:
        steps: `[points]`, increasing.
        values: `[points]`; NaN is below every threshold.
        threshold: In the unit of `values`.

    Returns:
        Steps of the last evaluation and False if the threshold is never reached; None for a run
        without evaluations.
    """
    if not len(steps):
        return None
    above = np.flatnonzero(values >= threshold)
    return (float(steps[above[0]]), True) if len(above) else (float(steps[-1]), False)


def censored_median(steps: Array, reached: NDArray[np.bool_]) -> Estimate:
    """Kaplan-Meier median (1958) of times that are partly censored, with its interval.

    A run that ends below the threshold is *censored*: it would have taken longer than its steps.
    Leaving it out would make the worst setting look fast. A run that is censored at a step at which
    another run arrives counts as not arrived at that step.

    The interval comes from the order of the runs and holds for every distribution: n runs are all
    below the median with probability 1/2^n. A censored run counts at its last step for the lower
    end, and as infinite for the upper end.

    Args:
        steps: `[R]` steps to the threshold, or to the last evaluation of a censored run.
        reached: `[R]`, whether the run reached the threshold.

    Returns:
        The median, infinite if fewer than half of the runs arrive, and an interval with a coverage
        of at least 93%, NaN for fewer than `FEWEST_FOR_INTERVAL` runs.
    """
    runs, below, median = len(steps), 1.0, np.inf
    for step in np.unique(steps[reached]):
        below *= 1 - np.sum((steps == step) & reached) / np.sum(steps >= step)
        if below <= 0.5 + 1e-12:
            median = step
            break
    outside = 2 * bdtr(np.arange(runs), runs, 0.5)
    cut = int(np.sum(outside <= 1 - _COVERAGE)) - 1
    lower = upper = np.nan
    if cut >= 0:
        lower = np.sort(steps)[cut]
        upper = np.sort(np.where(reached, steps, np.inf))[runs - 1 - cut]
    return Estimate(value=np.asarray(median), lower=np.asarray(lower), upper=np.asarray(upper))


# Seeds needed -------------------------------------------------------------------------------------


def seeds_needed(
    size: float, spread: float, *, paired: bool, level: float = SIGNIFICANCE
) -> tuple[int | None, int | None]:
    """Numbers of seeds of each condition that decide with a power of 80%.

    Args:
        size: Difference of the means, and margin of equivalence, > 0.
        spread: Standard deviation of a difference between single seeds, > 0.
        paired: Whether conditions share their seeds.
        level: Level of the two-sided test, and of each one-sided test of equivalence; Holm's
            correction tests the first of k at 0.05 / k.

    Returns:
        Numbers to detect a difference of `size`, and to show equivalence within it if there is no
        difference; None if `MAX_SEEDS` are not enough.
    """

    def tails(seeds: int, tail: float) -> Array:
        """Probabilities of t below its quantiles `tail` and `1 - tail` if there is a difference."""
        freedom = (1 if paired else 2) * (seeds - 1)
        end = stdtrit(freedom, 1 - tail)
        below = nctdtr(freedom, size / spread * math.sqrt(seeds), [-end, end])
        return np.asarray(np.nan_to_num(below, nan=0.0))  # scipy's NaN far from the center

    def detects(seeds: int) -> bool:
        low, high = tails(seeds, level / 2)
        return bool(1 - high + low >= POWER)

    def excludes(seeds: int) -> bool:
        # Both one-sided tests must reject. Either one misses with the same probability.
        return bool(1 - 2 * tails(seeds, level)[1] >= POWER)

    counts = range(2, MAX_SEEDS + 1)  # one seed never decides
    first = [bisect_left(counts, True, key=enough) for enough in (detects, excludes)]
    difference, equivalence = (counts[at] if at < len(counts) else None for at in first)
    return difference, equivalence


def _ratio(total: ArrayLike, count: ArrayLike) -> Array:
    """`total / count`; NaN where `count` is not > 0."""
    total, count = (np.asarray(part, dtype=float) for part in np.broadcast_arrays(total, count))
    out: Array = np.full(total.shape, np.nan)
    np.divide(total, count, out=out, where=count > 0)
    return out


# As text ------------------------------------------------------------------------------------------


def number(value: float | Array) -> str:
    """A value with two decimals, or without decimals from 100 on."""
    value = float(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"


def with_interval(value: float | None, ends: Sequence[float | None] | None) -> str:
    """`0.45 [0.30, 0.60]`, or `0.45` without an interval.

    The decimals are those of :func:`interval_text`.
    """
    if value is None:
        return "-"
    low, high = ends or (None, None)
    if low is None or high is None or low != low or high != high:
        return number(value) if abs(value) >= 100 else f"{value:.3g}"
    decimals = decimals_of(value, low, high)
    value, low, high = (round(one, decimals) + 0.0 for one in (value, low, high))
    return f"{value:,.{decimals}f} [{low:,.{decimals}f}, {high:,.{decimals}f}]"


def decimals_of(value: float, low: float, high: float) -> int:
    """Two decimals, none from 100 on, and as many as a narrower interval needs."""
    decimals = 0 if max(abs(value), abs(low), abs(high)) >= 100 else 2
    if 0 < high - low < math.inf:
        decimals = max(decimals, -math.floor(math.log10(high - low)))
    return decimals


def interval_text(estimate: Estimate) -> str:
    """`0.62 to 0.81`, or `no interval`."""
    if not estimate.has_interval:
        return "no interval"
    _, low, high = numbers = estimate.numbers
    decimals = decimals_of(*numbers)
    return f"{low:,.{decimals}f} to {high:,.{decimals}f}"


def value_text(estimate: Estimate) -> str:
    """`0.45`, with as many decimals as its interval."""
    if not estimate.has_interval:
        return number(estimate.value)
    value, *_ = numbers = estimate.numbers
    decimals = decimals_of(*numbers)
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


def difference_text(estimate: Estimate) -> str:
    """`+0.12`, with as many decimals as its interval."""
    value, *_ = numbers = estimate.numbers
    return f"{value:+,.{decimals_of(*numbers)}f}"


def p_text(p_value: float) -> str:
    """`p = 0.03`."""
    if p_value < 0.001:
        return "p < 0.001"
    texts = (f"{p_value:.{digits}g}" for digits in range(2, 18))
    side = np.sign(p_value - SIGNIFICANCE)
    return "p = " + next(one for one in texts if np.sign(float(one) - SIGNIFICANCE) == side)
