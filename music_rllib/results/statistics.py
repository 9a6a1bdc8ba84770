"""What may be said from a few seeds: rliable's estimates, and how many more seeds would tell.

Shapes: R runs (seeds) of one condition on each of T tasks. `scores` is `[R, T]` or, for curves,
`[R, T, points]`, and NaN marks a run that does not exist, so tasks may have different numbers of
runs. Randomness comes in as `rng`.

Definitions are those of Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (https://arxiv.org/abs/2108.13264), as its library rliable computes them. One
thing is stricter here: where a task has a single run there is no interval (NaN), since resampling
one run would show certainty that nobody has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

__all__ = [
    "CONFIDENCE",
    "SIGNIFICANCE",
    "Array",
    "Estimate",
    "estimate",
    "holm",
    "improvement",
    "improvement_p_value",
    "interquartile_mean",
    "mean",
    "performance_profile",
    "pooled_spread",
    "power_of",
    "probability_of_improvement",
    "seeds_to_decide",
]

Array = NDArray[np.float64]

CONFIDENCE = 0.95
SIGNIFICANCE = 0.05
RESAMPLES = 2000
PERMUTATIONS = 10_000
MAX_SEEDS = 1000
"""Beyond it, "how many seeds" is answered with "more than anyone will run"."""
_CHUNK = 4_000_000
"""Numbers resampled at a time: bounds memory at some tens of megabytes."""


class Statistic(Protocol):
    """A statistic of the values along an axis; leaves out NaN, is NaN where there is no value."""

    def __call__(self, values: Array, axis: int) -> Array: ...


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
        return bool(np.all(np.isfinite(self.lower)))

    def overlaps(self, other: Estimate) -> bool:
        """Whether the intervals of two numbers have a point in common; so does a missing one."""
        apart = (self.lower > other.upper) | (other.lower > self.upper)
        return not bool(apart)


def interquartile_mean(values: Array, axis: int = -1) -> Array:
    """Mean of the middle half: the lowest and highest `floor(n/4)` of n values are cut off."""
    ordered = np.sort(np.moveaxis(values, axis, -1), axis=-1)  # NaN goes last
    size = ordered.shape[-1]
    if size and not np.isnan(ordered[..., -1]).any():  # by far the most common, and the fastest
        return np.asarray(np.mean(ordered[..., size // 4 : size - size // 4], axis=-1))
    count = np.sum(~np.isnan(ordered), axis=-1, keepdims=True)
    cut = count // 4
    rank = np.arange(size)
    kept = (rank >= cut) & (rank < count - cut)
    return _ratio(np.sum(ordered, axis=-1, where=kept), np.sum(kept, axis=-1))


def mean(values: Array, axis: int = -1) -> Array:
    """Mean of the values that are there."""
    there = ~np.isnan(values)
    return _ratio(np.sum(values, axis=axis, where=there), np.sum(there, axis=axis))


def estimate(
    scores: Array,
    rng: np.random.Generator,
    statistic: Statistic = interquartile_mean,
    resamples: int = RESAMPLES,
) -> Estimate:
    """`statistic` over all runs and tasks, with its stratified-bootstrap percentile interval.

    Runs are resampled within each task; a curve is resampled whole.

    Args:
        scores: `[R, T]` or `[R, T, points]`.
        rng: for the resamples.
        statistic: over runs and tasks pooled.
        resamples: the more, the steadier the interval's ends.

    Returns:
        Scalars, or `[points]`.
    """
    value = statistic(_pooled(scores[np.newaxis]), 1)[0]
    drawn = [statistic(_pooled(part), 1) for part in _resampled(scores, rng, resamples)]
    lower, upper = _percentiles(np.concatenate(drawn)) if drawn else (_nan(value), _nan(value))
    lonely = np.min(np.sum(~np.isnan(scores), axis=0), axis=0, initial=2) < 2
    return Estimate(
        value=value, lower=np.where(lonely, np.nan, lower), upper=np.where(lonely, np.nan, upper)
    )


def performance_profile(
    scores: Array, thresholds: Array, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Share of runs with a score above each threshold (rliable's run-score distribution).

    Args:
        scores: `[R, T]`.
        thresholds: `[points]`.
        rng: for the interval.
        resamples: of the bootstrap.

    Returns:
        `[points]`.
    """
    above = (scores[..., np.newaxis] > thresholds).astype(float)
    above[np.isnan(scores)] = np.nan
    return estimate(above, rng, mean, resamples)


def improvement(x: Array, y: Array) -> float:
    """P(a run of x scores higher than a run of y), ties counted half, averaged over tasks.

    Args:
        x: `[Rx, T]`.
        y: `[Ry, T]`, the same tasks.
    """
    return float(np.mean([np.mean(wins) for wins in _wins(x, y)]))


def probability_of_improvement(
    x: Array, y: Array, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """`improvement` with its interval; x and y are resampled independently, within each task."""
    value = np.asarray(improvement(x, y))
    tasks = _wins(x, y)
    if min(min(wins.shape) for wins in tasks) < 2:
        return Estimate(value=value, lower=_nan(value), upper=_nan(value))
    drawn = np.mean([_resampled_wins(wins, rng, resamples) for wins in tasks], axis=0)
    lower, upper = _percentiles(drawn)
    return Estimate(value=value, lower=lower, upper=upper)


def improvement_p_value(
    x: Array, y: Array, rng: np.random.Generator, permutations: int = PERMUTATIONS
) -> float:
    """How often relabelled runs differ as much as x and y do: a two-sided permutation test.

    The statistic is `improvement`; labels are permuted within each task. Unlike an interval from
    two or three runs it cannot overstate: with 3 runs against 3 it never falls below .1.
    """
    observed = abs(improvement(x, y) - 0.5)
    total = np.zeros(permutations)
    tasks = [(_there(x[:, task]), _there(y[:, task])) for task in range(x.shape[1])]
    for a, b in tasks:
        ranks = stats.rankdata(np.concatenate([a, b]))
        shuffled = rng.permuted(np.tile(ranks, (permutations, 1)), axis=1)
        # Mann and Whitney's U from the ranks' sum.
        u = shuffled[:, : len(a)].sum(axis=1) - len(a) * (len(a) + 1) / 2
        total += u / (len(a) * len(b))
    extreme = np.abs(total / len(tasks) - 0.5) >= observed - 1e-12
    return float((1 + np.sum(extreme)) / (1 + permutations))


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for having made several comparisons (Holm 1979)."""
    order = np.argsort(p_values)
    scaled = np.asarray(p_values, dtype=float)[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return [float(value) for value in adjusted]


def pooled_spread(groups: Sequence[Array]) -> float | None:
    """Standard deviation between seeds of the same condition and task, over all of `groups`.

    Args:
        groups: one `[R, T]` per condition.

    Returns:
        None where no condition has two runs of the same task.
    """
    squares, freedom = 0.0, 0
    for scores in groups:
        for task in range(scores.shape[1]):
            values = _there(scores[:, task])
            if len(values) > 1:
                squares += float(np.sum((values - values.mean()) ** 2))
                freedom += len(values) - 1
    return float(np.sqrt(squares / freedom)) if freedom else None


def power_of(
    seeds: int, difference: float, spread: float, *, tasks: int = 1, alpha: float = 0.05
) -> float:
    """Chance that a two-sided t test tells two conditions apart.

    Args:
        seeds: of each condition on each task, >= 2.
        difference: between the conditions' means.
        spread: standard deviation between seeds (:func:`pooled_spread`), > 0.
        tasks: whose differences are averaged.
        alpha: chance of seeing a difference where there is none.
    """
    freedom = 2 * tasks * (seeds - 1)
    shift = abs(difference) / spread * np.sqrt(seeds * tasks / 2)
    critical = stats.t.ppf(1 - alpha / 2, freedom)
    missed = stats.nct.cdf(critical, freedom, shift) - stats.nct.cdf(-critical, freedom, shift)
    # Far from the centre scipy's cdf is NaN where it would be 0.
    return float(1 - np.nan_to_num(missed, nan=0.0))


def seeds_to_decide(
    difference: float,
    spread: float,
    *,
    tasks: int = 1,
    power: float = 0.8,
    alpha: float = 0.05,
) -> int | None:
    """Seeds for each condition and task with which `difference` is seen with chance `power`.

    Arguments are those of :func:`power_of`.

    Returns:
        None where `MAX_SEEDS` are not enough.

    Raises:
        ValueError: where `difference` or `spread` is not > 0.
    """
    for name, value in (("difference", difference), ("spread", spread)):
        if not value > 0:
            raise ValueError(f"{name} must be > 0, got {value}")

    def decides(seeds: int) -> bool:
        return power_of(seeds, difference, spread, tasks=tasks, alpha=alpha) >= power

    if not decides(MAX_SEEDS):
        return None
    low, high = 1, MAX_SEEDS  # one seed never decides
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if decides(middle) else (middle, high)
    return high


def _resampled(scores: Array, rng: np.random.Generator, resamples: int) -> Iterator[Array]:
    """Parts of `[resamples, R, T, ...]`: each task's runs drawn anew, as many as there were."""
    step = max(1, _CHUNK // max(scores.size, 1))
    for begin in range(0, resamples, step):
        count = min(step, resamples - begin)
        drawn = np.full((count, *scores.shape), np.nan)
        for task in range(scores.shape[1]):
            runs = _runs(scores[:, task])
            if len(runs):
                chosen = runs[rng.integers(len(runs), size=(count, len(runs)))]
                drawn[:, : len(runs), task] = scores[chosen, task]
        yield drawn


def _runs(scores: Array) -> NDArray[np.intp]:
    """Indices of the runs of one task, `[R]` or `[R, points]`, that have a value."""
    there = ~np.isnan(scores)
    return np.flatnonzero(there.any(axis=tuple(range(1, scores.ndim))))


def _pooled(scores: Array) -> Array:
    """`[n, R, T, ...]` to `[n, R * T, ...]`."""
    return scores.reshape(len(scores), scores.shape[1] * scores.shape[2], *scores.shape[3:])


def _wins(x: Array, y: Array) -> list[Array]:
    """For each task `[Rx, Ry]`: 1 where x is higher, 1/2 where they are equal."""
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"x and y must have the same tasks, got {x.shape[1]} and {y.shape[1]}")
    pairs = []
    for task in range(x.shape[1]):
        a, b = _there(x[:, task])[:, np.newaxis], _there(y[:, task])
        if not (len(a) and len(b)):
            raise ValueError(f"x and y must have a run of every task, task {task} has none")
        pairs.append((a > b) + 0.5 * (a == b))
    return pairs


def _resampled_wins(wins: Array, rng: np.random.Generator, resamples: int) -> Array:
    """Mean of `wins` for runs of either side drawn anew: `[resamples]`."""
    rows, columns = (
        rng.multinomial(size, np.full(size, 1 / size), size=resamples) for size in wins.shape
    )
    return np.asarray(np.einsum("bi,ij,bj->b", rows, wins, columns, optimize=True) / wins.size)


def _percentiles(drawn: Array) -> tuple[Array, Array]:
    """Ends of the percentile interval over the first axis; NaN where nothing was drawn."""
    tail = (1 - CONFIDENCE) / 2
    if np.isnan(drawn).any():
        counted = np.where(np.isnan(drawn).all(axis=0), 0.0, drawn)
        ends = np.nanquantile(counted, [tail, 1 - tail], axis=0)
        ends = np.where(np.isnan(drawn).all(axis=0), np.nan, ends)
    else:
        ends = np.quantile(drawn, [tail, 1 - tail], axis=0)
    return ends[0], ends[1]


def _there(values: ArrayLike) -> Array:
    array: Array = np.asarray(values, dtype=float)
    return array[~np.isnan(array)]


def _ratio(total: Array, count: NDArray[np.int_]) -> Array:
    out: Array = np.full(np.shape(total), np.nan)
    return np.divide(total, count, out=out, where=count > 0)


def _nan(like: Array) -> Array:
    return np.full(np.shape(like), np.nan)
