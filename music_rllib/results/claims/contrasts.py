"""Contrasts of two conditions: their difference, its tests, and what these decide.

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

import numpy as np
from scipy import stats

from music_rllib.results.statistics import (
    SIGNIFICANCE,
    Array,
    Estimate,
    fewest_seeds,
    holm,
    power_of_t_test,
)

_TIED = 1e-6
"""Standard deviations below it are rounding errors: the seeds tie."""


class Verdict(StrEnum):
    """Outcome of a comparison; each wrong one has a chance of at most 5 %."""

    SUPERIOR = "superior"
    WORSE = "worse"
    EQUIVALENT = "equivalent"
    """The difference is within the margin, whether or not there is some."""
    UNDECIDED = "undecided"


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """The difference `x - y` and its tests."""

    difference: Estimate
    """Difference of the means, with its 95 % interval."""
    p_value: Array
    """Two-sided p-value of no difference; 1 where there are too few seeds for a test."""
    p_equivalent: Array | None
    """p-value of a difference of the margin or more; None without a margin."""
    spread: Array
    """Standard deviation of a difference between single seeds; NaN where it is not known."""
    paired: bool
    seeds: tuple[int, int]
    """Number of seeds of `x` and of `y`."""


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
        paired: whether seeds are compared in pairs.
        margin: > 0, below which a difference does not matter; None: equivalence is not tested.
        apart: the difference, with an interval from what is known of each condition alone, such as
            its evaluation episodes. Where all seeds tie this interval stands, and equivalence is
            not claimed beyond it.

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
        unknown, certain = np.full(value.shape, np.nan), np.ones(value.shape)
        return Contrast(
            difference=Estimate(value=value, lower=unknown, upper=unknown),
            p_value=certain,
            p_equivalent=None if margin is None else certain,
            spread=unknown,
            paired=paired,
            seeds=(len(x), len(y)),
        )
    spread, error, freedom = _student(x, y, paired)
    tied = spread < _TIED
    # Ways to relabel tied seeds, none but one of which is as far apart: of pairs each difference
    # may have the other sign, of groups each choice of seeds counts.
    ways = 2 ** len(x) if paired else comb(len(x) + len(y), len(x))

    def p_greater(difference: Array) -> Array:
        """One-sided p-value of a mean difference as large as this one."""
        with np.errstate(divide="ignore", invalid="ignore"):
            student = stats.t.sf(difference / error, freedom)
        return np.where(tied, np.where(difference > _TIED, 1 / ways, 1.0), student)

    half = stats.t.ppf(1 - SIGNIFICANCE / 2, freedom) * np.where(tied, np.nan, error)
    lower, upper = value - half, value + half
    if apart is not None:
        lower, upper = np.where(tied, apart.lower, lower), np.where(tied, apart.upper, upper)
    p_equivalent = None
    if margin is not None:
        p_equivalent = np.maximum(p_greater(margin + value), p_greater(margin - value))
        if apart is not None:
            beyond = (apart.lower <= -margin) | (apart.upper >= margin)
            p_equivalent = np.where(tied & beyond, 1.0, p_equivalent)
    return Contrast(
        difference=Estimate(value=value, lower=lower, upper=upper),
        p_value=np.minimum(1.0, 2 * p_greater(np.abs(value))),
        p_equivalent=p_equivalent,
        spread=np.where(tied, np.nan, spread),
        paired=paired,
        seeds=(len(x), len(y)),
    )


def _student(x: Array, y: Array, paired: bool) -> tuple[Array, Array, Array]:
    """Student's test of pairs, or Welch's, along the seeds.

    As scipy's `ttest_rel` and `ttest_ind`, which warn where a condition has no spread.

    Returns:
        Standard deviation of a difference, standard error of its mean, degrees of freedom.
    """
    samples = [x - y] if paired else [x, y]
    variances = np.stack([np.var(sample, axis=0, ddof=1) for sample in samples])
    sizes = np.reshape([len(sample) for sample in samples], (-1, *[1] * (variances.ndim - 1)))
    parts = variances / sizes
    squares = (parts**2 / (sizes - 1)).sum(axis=0)
    with np.errstate(invalid="ignore"):
        freedom = parts.sum(axis=0) ** 2 / squares
    return np.sqrt(variances.sum(axis=0)), np.sqrt(parts.sum(axis=0)), freedom


def verdict_of(difference: float, p_value: float, p_equivalent: float | None) -> Verdict:
    """The verdict from adjusted p-values.

    A difference that is surely within the margin does not matter, so equivalence goes before a
    difference that is surely there.
    """
    if p_equivalent is not None and p_equivalent < SIGNIFICANCE:
        return Verdict.EQUIVALENT
    if p_value < SIGNIFICANCE:
        return Verdict.SUPERIOR if difference > 0 else Verdict.WORSE
    return Verdict.UNDECIDED


def decide(
    contrasts: Sequence[Contrast], without_test: int = 0
) -> list[tuple[float, float | None, Verdict]]:
    """Adjusted p-values of no difference and of no equivalence, and the verdict, of each contrast.

    Both kinds are adjusted by Holm's method over the contrasts of the list: exactly what is shown
    together. So many more `without_test`, which were planned, count with p = 1: otherwise a
    condition whose runs all fail would make the other claims easier.
    """
    rest = [1.0] * without_test
    p_values = holm([*(float(one.p_value) for one in contrasts), *rest])[: len(contrasts)]
    tested = [float(one.p_equivalent) for one in contrasts if one.p_equivalent is not None]
    adjusted = iter(holm([*tested, *rest]))
    decisions = []
    for one, p_value in zip(contrasts, p_values, strict=True):
        p_equivalent = None if one.p_equivalent is None else next(adjusted)
        verdict = verdict_of(float(one.difference.value), p_value, p_equivalent)
        decisions.append((p_value, p_equivalent, verdict))
    return decisions


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
