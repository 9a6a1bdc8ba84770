"""One condition against another: their difference, its tests, and what they decide.

Shapes: `x` and `y` are `[seeds]`, or `[seeds, draws]` for many studies at once (simulations); the
results have the shape of the draws. Conditions that share their seeds share initial weights,
evaluation goals and pretraining, so their differences are taken seed by seed.

Tests: Student's on the differences of a seed, Welch's without common seeds; two one-sided tests
(Schuirmann 1987, https://doi.org/10.1007/BF01068419) for equivalence within a margin; scipy's each.
Where all seeds tie there is no spread to go by, and relabelling them is the exact test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from music_rllib.results.statistics import MAX_SEEDS, SIGNIFICANCE, Array, Estimate, holm

__all__ = ["Contrast", "Verdict", "contrast", "decide", "seeds_for_difference"]
__all__ += ["seeds_for_equivalence", "verdict_of"]

_TIED = 1e-6
"""Standard deviations below it are rounding errors: the seeds tie."""


class Verdict(StrEnum):
    """What a comparison came to; each wrong one has a chance of at most 5 %."""

    SUPERIOR = "superior"
    WORSE = "worse"
    EQUIVALENT = "equivalent"
    """Within the margin, whether or not there is some difference."""
    UNDECIDED = "undecided"


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """`x - y`."""

    difference: Estimate
    """Of the means, with its 95 % interval."""
    p_value: Array
    """Two-sided, of no difference; 1 where there are too few seeds for a test."""
    p_equivalent: Array | None
    """Of a difference of the margin or more; None without a margin."""
    spread: Array
    """Standard deviation of a difference between single seeds; NaN where it is not known."""
    paired: bool
    seeds: tuple[int, int]
    """Of `x` and `y`; the pairs where it is paired."""


def contrast(
    x: Array,
    y: Array,
    *,
    paired: bool,
    margin: float | None = None,
    apart: Estimate | None = None,
) -> Contrast:
    """Compare two conditions.

    Args:
        x: `[m]` or `[m, draws]`, a score for each seed.
        y: `[n]` or `[n, draws]`; with `paired` of the same seeds in the same order.
        paired: whether they are.
        margin: > 0, below which a difference does not matter; None: equivalence is not tested.
        apart: interval of the difference by what is known of each condition alone, such as its
            evaluation episodes; it stands where all seeds tie, and equivalence is not claimed
            beyond it.

    Raises:
        ValueError: `margin` is not > 0, or pairs are incomplete.
    """
    if margin is not None and not margin > 0:
        raise ValueError(f"margin must be > 0, got {margin}")
    if paired and len(x) != len(y):
        raise ValueError(f"pairs must be complete, got {len(x)} and {len(y)} seeds")
    x, y = np.asarray(x, float), np.asarray(y, float)
    value = np.asarray(x.mean(axis=0) - y.mean(axis=0))
    if min(len(x), len(y)) < 2:
        nothing, one = np.full(value.shape, np.nan), np.ones(value.shape)
        return Contrast(
            difference=Estimate(value=value, lower=nothing, upper=nothing),
            p_value=one,
            p_equivalent=None if margin is None else one,
            spread=nothing,
            paired=paired,
            seeds=(len(x), len(y)),
        )
    test = _Student(x, y, paired)
    tied = test.spread < _TIED
    exact = _Relabelled(len(x), len(y), paired)
    half = stats.t.ppf(1 - SIGNIFICANCE / 2, test.freedom) * np.where(tied, np.nan, test.error)
    lower, upper = value - half, value + half
    p_value = np.where(tied, exact.two_sided(value), 2 * test.greater(np.abs(value)))
    if apart is not None:
        lower, upper = np.where(tied, apart.lower, lower), np.where(tied, apart.upper, upper)
    p_equivalent = None
    if margin is not None:
        p_equivalent = np.where(
            tied,
            np.maximum(exact.greater(value + margin), exact.greater(margin - value)),
            np.maximum(test.greater(margin + value), test.greater(margin - value)),
        )
        if apart is not None:
            beyond = (apart.lower <= -margin) | (apart.upper >= margin)
            p_equivalent = np.where(tied & beyond, 1.0, p_equivalent)
    return Contrast(
        difference=Estimate(value=value, lower=lower, upper=upper),
        p_value=p_value,
        p_equivalent=p_equivalent,
        spread=np.where(tied, np.nan, test.spread),
        paired=paired,
        seeds=(len(x), len(y)),
    )


class _Student:
    """Student's test of pairs, or Welch's, along the seeds.

    As scipy's `ttest_rel` and `ttest_ind`, which warn where a condition has no spread.
    """

    def __init__(self, x: Array, y: Array, paired: bool) -> None:
        samples = [x - y] if paired else [x, y]
        variances = np.stack([np.var(one, axis=0, ddof=1) for one in samples])
        sizes = np.reshape([len(one) for one in samples], (-1, *[1] * (variances.ndim - 1)))
        parts = variances / sizes
        squares = (parts**2 / (sizes - 1)).sum(axis=0)
        self.spread, self.error = np.sqrt(variances.sum(axis=0)), np.sqrt(parts.sum(axis=0))
        with np.errstate(invalid="ignore"):
            self.freedom = parts.sum(axis=0) ** 2 / squares

    def greater(self, difference: Array) -> Array:
        """One-sided p-value of a mean difference as large as this one."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(stats.t.sf(difference / self.error, self.freedom))


class _Relabelled:
    """The permutation test where all differences are the same: no relabelling but one is as far.

    Of pairs each sign may be the other one, 2^n ways; of groups each choice of seeds counts.
    """

    def __init__(self, m: int, n: int, paired: bool) -> None:
        self._ways = 2**m if paired else comb(m + n, m)

    def two_sided(self, difference: Array) -> Array:
        return np.where(np.abs(difference) < _TIED, 1.0, min(1.0, 2 / self._ways))

    def greater(self, difference: Array) -> Array:
        return np.where(difference > _TIED, 1 / self._ways, 1.0)


def verdict_of(difference: float, p_value: float, p_equivalent: float | None) -> Verdict:
    """What adjusted p-values decide.

    A difference that is surely within the margin is one that does not matter, so that equivalence
    goes before a difference that is surely there.
    """
    if p_equivalent is not None and p_equivalent < SIGNIFICANCE:
        return Verdict.EQUIVALENT
    if p_value < SIGNIFICANCE:
        return Verdict.SUPERIOR if difference > 0 else Verdict.WORSE
    return Verdict.UNDECIDED


def decide(contrasts: Sequence[Contrast]) -> list[tuple[float, float | None, Verdict]]:
    """Adjusted p-values of no difference and of no equivalence, and the verdict, of each contrast.

    Both kinds are adjusted by Holm's method over the contrasts of the list: exactly what is shown
    together.
    """
    p_values = holm([float(one.p_value) for one in contrasts])
    tested = [float(one.p_equivalent) for one in contrasts if one.p_equivalent is not None]
    adjusted = iter(holm(tested))
    found = []
    for one, p_value in zip(contrasts, p_values, strict=True):
        p_equivalent = None if one.p_equivalent is None else next(adjusted)
        verdict = verdict_of(float(one.difference.value), p_value, p_equivalent)
        found.append((p_value, p_equivalent, verdict))
    return found


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
        None where `MAX_SEEDS` are not enough.
    """

    def power(seeds: NDArray[np.int64]) -> Array:
        freedom, shift = _student(seeds, difference, spread, paired)
        critical = stats.t.ppf(1 - level / 2, freedom)
        # The other tail, below -critical, has a share that no number of seeds turns on.
        return np.asarray(stats.nct.sf(critical, freedom, shift))

    return _fewest(power)


def seeds_for_equivalence(
    margin: float, spread: float, *, paired: bool, level: float = SIGNIFICANCE
) -> int | None:
    """Seeds that show equivalence within `margin` with a chance of 80 % where all is equal.

    Arguments are those of :func:`seeds_for_difference`; `level` is that of either one-sided test.
    """

    def power(seeds: NDArray[np.int64]) -> Array:
        freedom, shift = _student(seeds, margin, spread, paired)
        critical = stats.t.ppf(1 - level, freedom)
        # Both tests have to reject; the chance that one of them does not is twice that of either.
        return np.asarray(1 - 2 * stats.nct.cdf(critical, freedom, shift))

    return _fewest(power)


def _student(
    seeds: NDArray[np.int64], difference: float, spread: float, paired: bool
) -> tuple[Array, Array]:
    """Degrees of freedom, and how far from 0 the statistic is expected."""
    freedom = np.asarray((seeds - 1.0) * (1 if paired else 2))
    return freedom, np.asarray(difference / spread * np.sqrt(seeds), dtype=float)


def _fewest(power: Any) -> int | None:
    seeds = np.arange(2, MAX_SEEDS + 1)
    # Far from the centre scipy's tails are NaN where they would be certain.
    enough = np.nan_to_num(power(seeds), nan=1.0) >= 0.8
    return int(seeds[enough.argmax()]) if enough.any() else None
