"""Statistics of few seeds: estimates with intervals that cover, and seeds needed.

Shapes: R runs (seeds) of one condition on each of T tasks. `scores` is `[R, T]` or, for curves,
`[R, T, points]`, and NaN marks a run that does not exist, so tasks may have different numbers of
runs. Nothing here is random: the same scores always give the same numbers.

The estimate is the mean: over each task's runs, then over the tasks. The interquartile mean that
Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264) show is another quantity with each number of
seeds below ten (of three it trims nothing, of four half) and leaves out the seed that failed. Their
percentile bootstrap covers 74 % with three seeds where it says 95 %; coverage of the intervals here
is held by `tests/unit/results/test_coverage.py` and listed in docs/reports.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from music_rllib.imports import imported_on_use

stats = imported_on_use("scipy.stats")

Array = NDArray[np.float64]

SIGNIFICANCE = 0.05
POWER = 0.8
"""Chance with which a difference is to be seen."""
MAX_SEEDS = 1000
"""Largest number of seeds that is looked for; more are more than anyone will run."""
_TAIL = 0.025
"""Probability on either side of a 95 % interval."""
_COVERAGE = 0.93
"""Least coverage of the interval of a median."""
_NO_SPREAD = 1e-12
"""Variances below it are rounding errors: the seeds tie."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A value with its 95 % interval, each of the shape of what was estimated."""

    value: Array
    lower: Array
    """NaN where there is no interval."""
    upper: Array

    @property
    def has_interval(self) -> bool:
        """Whether there is an interval everywhere."""
        return bool(np.all(np.isfinite(self.lower) & np.isfinite(self.upper)))


def estimate(scores: Array, episodes: float | None = None) -> Estimate:
    """Mean over the runs of each task and then over the tasks, with its 95 % interval.

    Tasks are strata: only the spread between runs of the same task counts. The degrees of freedom
    of their pooled variance are Welch and Satterthwaite's. See :func:`interval` for its ends.

    Args:
        scores: `[R, T]` or `[R, T, points]`.
        episodes: evaluation episodes behind each score where the metric is a rate (a share of
            episodes), infinite where that is not known; None where it is no rate.

    Returns:
        Scalars, or `[points]`; the ends are NaN where a task has fewer than two runs.
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
    return interval(
        of_task.mean(axis=0),
        variance / tasks**2,
        freedom,
        None if episodes is None else episodes * runs.sum(axis=0),
    )


def interval(
    value: ArrayLike, variance: ArrayLike, freedom: ArrayLike, episodes: ArrayLike | None = None
) -> Estimate:
    """95 % interval around an estimated mean of few runs.

    Of a metric without bounds it is Student's. Of a rate it is Korn and Graubard's (1998, Survey
    Methodology 24, 193-201), the standard for proportions from clusters: Clopper and Pearson's with
    the number of independent episodes that would give this variance, lessened for the few degrees
    of freedom. So it stays within [0, 1], is longer on the side away from a ceiling, and where all
    runs tie it is the exact interval over their episodes.

    Args:
        value: the mean.
        variance: that of the mean.
        freedom: degrees of freedom of `variance`; 0 or NaN: no interval.
        episodes: number of all episodes behind a rate; None for a metric that is no rate.

    Returns:
        The interval; its ends are NaN also where the runs tie and there are no episodes to go by.
    """
    value, variance, freedom = (
        np.asarray(part, dtype=float) for part in np.broadcast_arrays(value, variance, freedom)
    )
    t = stats.t.ppf(1 - _TAIL, np.where(freedom > 0, freedom, np.nan))
    tied = variance < _NO_SPREAD
    if episodes is None:
        half = np.where(tied, np.nan, t * np.sqrt(variance))
        return Estimate(value=value, lower=value - half, upper=value + half)
    alike = _ratio(value * (1 - value), np.where(tied, np.nan, variance))
    lessened = np.minimum(alike, episodes) * (stats.norm.ppf(1 - _TAIL) / t) ** 2
    trials = np.where(tied & ~np.isnan(t), episodes, lessened)
    lower, upper = clopper_pearson(value, trials)
    return Estimate(value=value, lower=lower, upper=upper)


def clopper_pearson(share: ArrayLike, trials: ArrayLike) -> tuple[Array, Array]:
    """Exact 95 % interval of a probability from the share of successes (1934).

    Args:
        share: successes by trials.
        trials: number, which need not be whole; NaN or infinite: no interval.
    """
    share, trials = (np.asarray(part, float) for part in np.broadcast_arrays(share, trials))
    trials = np.where(np.isfinite(trials), trials, np.nan)
    won, lost = share * trials, (1 - share) * trials
    lower = np.where(won > 0, stats.beta.ppf(_TAIL, won, lost + 1), 0 * trials)
    upper = np.where(lost > 0, stats.beta.ppf(1 - _TAIL, won + 1, lost), 1 + 0 * trials)
    return lower, upper


def difference(x: Estimate, y: Estimate) -> Estimate:
    """`x - y` of independent estimates, with an interval made from theirs.

    "Method of variance estimates recovery" (Zou and Donner 2008): it keeps their asymmetry.
    """
    value = x.value - y.value
    return Estimate(
        value=value,
        lower=value - np.hypot(x.value - x.lower, y.upper - y.value),
        upper=value + np.hypot(x.upper - x.value, y.value - y.lower),
    )


def performance_profile(scores: Array, thresholds: Array) -> Estimate:
    """Share of runs with a score above each threshold (rliable's run-score distribution).

    Args:
        scores: `[R, T]`.
        thresholds: `[points]`.

    Returns:
        `[points]`, with the exact interval of a share at each.
    """
    there = scores[~np.isnan(scores)]
    above = np.mean(there[:, np.newaxis] > thresholds, axis=0)
    lower, upper = clopper_pearson(above, len(there))
    return Estimate(value=above, lower=lower, upper=upper)


def improvement(x: Array, y: Array) -> float:
    """P(a run of x scores higher than a run of y), ties counted half, averaged over tasks.

    Args:
        x: `[Rx, T]`.
        y: `[Ry, T]`, the same tasks.
    """
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"x and y must have the same tasks, got {x.shape[1]} and {y.shape[1]}")
    shares = []
    for task in range(x.shape[1]):
        a, b = _there(x[:, task])[:, np.newaxis], _there(y[:, task])
        if not (len(a) and len(b)):
            raise ValueError(f"x and y must have a run of every task, task {task} has none")
        shares.append(np.mean((a > b) + 0.5 * (a == b)))
    return float(np.mean(shares))


def power_of_t_test(freedom: Array, shift: Array, level: float = SIGNIFICANCE) -> Array:
    """Chance that a two-sided t test is significant.

    Args:
        freedom: degrees of freedom.
        shift: expected value of the statistic, > 0.
        level: chance of seeing a difference where there is none.
    """
    critical = stats.t.ppf(1 - level / 2, freedom)
    # Far from the centre scipy's cdf is NaN where it would be 0.
    below, above = (
        np.nan_to_num(stats.nct.cdf(end, freedom, shift), nan=0.0) for end in (-critical, critical)
    )
    return np.asarray(1 - (above - below))


def fewest_seeds(power: Callable[[Array], Array]) -> int | None:
    """The least number of seeds with a `power` of 80 %; None where `MAX_SEEDS` are not enough."""
    seeds = np.arange(2.0, MAX_SEEDS + 1)  # one seed never decides
    enough = power(seeds) >= POWER
    return int(seeds[enough.argmax()]) if enough.any() else None


def _there(values: ArrayLike) -> Array:
    array: Array = np.asarray(values, dtype=float)
    return array[~np.isnan(array)]


def _ratio(total: ArrayLike, count: ArrayLike) -> Array:
    """`total / count`; NaN where `count` is not > 0."""
    total, count = (np.asarray(part, dtype=float) for part in np.broadcast_arrays(total, count))
    out: Array = np.full(total.shape, np.nan)
    np.divide(total, count, out=out, where=count > 0)
    return out


SHOW_SEEDS_BELOW = 10
"""Number of seeds from which on they are not shown one by one."""


def number(value: float | Array) -> str:
    """A value in short: two decimals, or none from 100 on."""
    value = float(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"


def with_interval(value: float | None, ends: Sequence[float | None] | None) -> str:
    """`0.45 [0.3, 0.6]`, or `0.45` without an interval."""
    if value is None:
        return "-"
    low, high = ends or (None, None)
    if low is None or high is None or low != low or high != high:
        return f"{value:.3g}"
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def interval_text(estimate: Estimate) -> str:
    """`0.62 to 0.81`, or `no interval`."""
    if not estimate.has_interval:
        return "no interval"
    return f"{number(estimate.lower)} to {number(estimate.upper)}"


def p_text(p_value: float) -> str:
    """`p = 0.03`."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.2g}"


FEWEST_FOR_INTERVAL = 5
"""Least number of runs for an interval of the median, which covers 93.75 %; of four 87.5 %."""


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


# Seeds needed -------------------------------------------------------------------------------------


def seeds_for_difference(
    difference: float, spread: float, *, paired: bool, level: float = SIGNIFICANCE
) -> int | None:
    """Seeds of each condition that show `difference` with a chance of 80 %.

    Args:
        difference: between the means, > 0.
        spread: standard deviation of a difference between single seeds, > 0.
        paired: whether conditions share their seeds.
        level: of the two-sided test; with Holm's correction the first of k has 5 % / k.

    Returns:
        The number; None where `MAX_SEEDS` are not enough.
    """
    groups = 1 if paired else 2
    return fewest_seeds(
        lambda seeds: power_of_t_test(
            groups * (seeds - 1), difference / spread * np.sqrt(seeds), level
        )
    )


def seeds_for_equivalence(
    margin: float, spread: float, *, paired: bool, level: float = SIGNIFICANCE
) -> int | None:
    """Seeds that show equivalence within `margin` with a chance of 80 % where all is equal.

    Arguments are those of :func:`seeds_for_difference`; `level` is that of either one-sided test.
    """

    def power(seeds: Array) -> Array:
        freedom = (1 if paired else 2) * (seeds - 1)
        critical = stats.t.ppf(1 - level, freedom)
        missed = stats.nct.cdf(critical, freedom, margin / spread * np.sqrt(seeds))
        # Both tests have to reject; the chance that one of them does not is twice that of either.
        # Far from the centre scipy's cdf is NaN where it would be 0.
        return np.asarray(1 - 2 * np.nan_to_num(missed, nan=0.0))

    return fewest_seeds(power)
