"""Claims: one condition against another, seed by seed, tested as one family.

Shapes: `x` and `y` are `[seeds]`, or `[seeds, draws]` for many simulated studies at once; results
then have the shape of the draws. Conditions that share all their seeds share initial weights,
evaluation goals and pretraining, so their differences are taken seed by seed.

Tests: Student's t on the differences of paired seeds, Welch's t otherwise; two one-sided tests
(Schuirmann 1987, https://doi.org/10.1007/BF01068419) for equivalence within a margin. Intervals use
the same standard error: the 95% CI excludes 0 if and only if p < 0.05, and the 90% CI lies within
the margin if and only if the TOST p < 0.05. `benchmarks/decisions.py` simulates the error rates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy.special import betaincinv, stdtr, stdtrit

from music_rllib import names
from music_rllib.config.schema import Hypothesis
from music_rllib.results.analysis_plan import MARGIN_OF_A_RATE
from music_rllib.results.conditions import ALL_TASKS, Condition
from music_rllib.results.data import Sweep
from music_rllib.results.scores import Measure, Scores, scores_of
from music_rllib.results.statistics import POWER, SIGNIFICANCE, Array, Estimate

FEWEST_SEEDS = 5
"""Smallest number of seeds per condition for a verdict."""
COLLAPSES = 0.05
"""Rate of collapses per seed from which on a verdict states that it does not exclude it."""
_COLLAPSED = 5
"""Robust standard deviations from the median from which on a seed counts as collapsed."""
_SEEDS_FOR_SPREAD = 16
"""Number of seeds from which on collapsed ones are counted. The median absolute deviation of fewer
seeds is too noisy, and they do not exclude collapses of one in ten anyway."""
_TIED = 1e-9
"""Standard errors below this share of the scores are rounding errors."""


class Verdict(StrEnum):
    """Outcome of a comparison."""

    SUPERIOR = "superior"
    WORSE = "worse"
    EQUIVALENT = "equivalent"
    """The difference is within the margin; a smaller difference is possible."""
    UNDECIDED = "undecided"
    NONE = "no verdict"
    """Too few seeds, unfinished runs, or a comparison that was not planned."""


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """The difference `x - y` and its tests."""

    difference: Estimate
    """Difference of the means with its 95% CI; no CI if the seeds tie or are single."""
    within: Estimate
    """The same with its 90% CI, which belongs to the equivalence test."""
    p_value: Array
    """Two-sided p-value of no difference; 1 without an interval."""
    p_equivalent: Array | None
    """p-value of a difference of the margin or more; None without a margin."""
    spread: Array
    """Standard deviation of a difference between single seeds, at least that of their evaluation
    episodes; NaN if unknown."""
    paired: bool
    seeds: tuple[int, int]
    collapsed: Array
    """Number of seeds far from all others, on the side that has more of them."""

    @property
    def p_values(self) -> tuple[float, float | None]:
        """p-values of no difference and of no equivalence of a single study."""
        return float(self.p_value), None if self.p_equivalent is None else float(self.p_equivalent)

    @property
    def collapses(self) -> Array:
        """Upper end, with 80% confidence, of the rate of collapses per seed (Clopper-Pearson).

        Without a collapse among n seeds this is 1 - 0.2^(1/n). If one seed of ten collapses and
        none was drawn, no test of these seeds can detect it.
        """
        seeds = min(self.seeds)
        return np.asarray(betaincinv(self.collapsed + 1, seeds - self.collapsed, POWER))


def contrast(
    x: Array, y: Array, *, paired: bool, margin: float | None = None, noise: float = 0.0
) -> Contrast:
    """Compare two conditions.

    Args:
        x: `[m]` or `[m, draws]`, a score for each seed.
        y: `[n]` or `[n, draws]`; if `paired`, for the same seeds in the same order.
        paired: Whether seeds are compared in pairs.
        margin: Difference below which conditions count as equivalent, > 0; None: no such test.
        noise: Standard error of the difference from the evaluation episodes alone. The standard
            error of the tests is at least this large, so that tied seeds do not count as certain.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    value = np.asarray(x.mean(axis=0) - y.mean(axis=0))
    spread = error = freedom = np.full(value.shape, np.nan)
    if min(len(x), len(y)) >= 2:
        spread, error, freedom = _student(x, y, paired)
        # More seeds reduce an error that comes from the episodes at the same rate.
        spread = spread * np.maximum(1.0, noise / np.where(error > 0, error, np.inf))
        error = np.maximum(error, noise)
        scale = np.maximum(np.abs(x).max(axis=0), np.abs(y).max(axis=0))
        error = np.where(error > _TIED * scale, error, np.nan)
        # Degrees of freedom are unknown without a spread.
        without_spread = len(x) - 1 if paired else len(x) + len(y) - 2
        freedom = np.where(np.isnan(freedom), without_spread, freedom)

    def p_greater(difference: Array) -> Array:
        """One-sided p-value of a mean difference of this size."""
        return np.asarray(np.nan_to_num(stdtr(freedom, -difference / error), nan=1.0))

    def with_interval(level: float) -> Estimate:
        half = stdtrit(freedom, (1 + level) / 2) * error
        return Estimate(value=value, lower=value - half, upper=value + half)

    p_equivalent = None
    if margin is not None:
        p_equivalent = np.maximum(p_greater(margin + value), p_greater(margin - value))
    return Contrast(
        difference=with_interval(1 - SIGNIFICANCE),
        within=with_interval(1 - 2 * SIGNIFICANCE),
        p_value=np.minimum(1.0, 2 * p_greater(np.abs(value))),
        p_equivalent=p_equivalent,
        spread=np.where(spread > 0, spread, np.nan),
        paired=paired,
        seeds=(len(x), len(y)),
        collapsed=np.max(
            [_far_off(one, margin or 0.0) for one in ([x - y] if paired else [x, y])], axis=0
        ),
    )


def _far_off(scores: Array, margin: float) -> Array:
    """Number of scores `[seeds, ...]` far from their median, by the median absolute deviation."""
    if len(scores) < _SEEDS_FOR_SPREAD:
        return np.zeros(scores.shape[1:])
    away = np.abs(scores - np.median(scores, axis=0))
    spread = 1.4826 * np.median(away, axis=0)  # a standard deviation for normal scores
    return np.asarray(np.sum(away > np.maximum(_COLLAPSED * spread, margin), axis=0))


def _student(x: Array, y: Array, paired: bool) -> tuple[Array, Array, Array]:
    """Standard deviation of a difference, standard error of its mean, degrees of freedom.

    Student's test of pairs, or Welch's test, along the seeds. They equal scipy's `ttest_rel` and
    `ttest_ind`, which warn if a condition has no spread.
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
    """The verdict from adjusted p-values; equivalence takes precedence over a small difference."""
    if p_equivalent is not None and p_equivalent < SIGNIFICANCE:
        return Verdict.EQUIVALENT
    if p_value < SIGNIFICANCE:
        return Verdict.SUPERIOR if difference > 0 else Verdict.WORSE
    return Verdict.UNDECIDED


def adjusted(
    p_values: Sequence[tuple[float, float | None]], without_test: int = 0
) -> list[tuple[float, float | None]]:
    """Adjusted p-values of no difference and of no equivalence of each contrast, as one family.

    Holm's method over both kinds of test with the multiplier of Shaffer (1986,
    https://doi.org/10.1080/01621459.1986.10478341): no difference and a difference of the margin
    exclude each other, so a contrast has at most one true hypothesis and counts once until both are
    rejected. The probability of any wrong verdict in the family is at most 5%.

    Args:
        p_values: p-values of no difference and of no equivalence (None without a margin) of each
            contrast that is shown with a verdict.
        without_test: Number of further planned comparisons that can't be tested. They count with
            p = 1; otherwise a condition without results would weaken the correction.
    """
    tests = [
        (p_value, position, kind)
        for position, pair in enumerate(p_values)
        for kind, p_value in enumerate(pair)
        if p_value is not None
    ]
    left = Counter(position for _, position, _ in tests)
    pairs, largest = len(p_values) + without_test, 0.0
    found: dict[tuple[int, int], float] = {}
    for p_value, position, kind in sorted(tests):
        largest = max(largest, min(1.0, pairs * p_value))
        found[position, kind] = largest
        left[position] -= 1
        pairs -= left[position] == 0
    return [(found[i, 0], found.get((i, 1))) for i in range(len(p_values))]


# Claims -------------------------------------------------------------------------------------------

Pairs = Sequence[tuple[Condition, Condition]]
"""Pairs of conditions that agree in all other settings."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One condition against another on a task, with its test and verdict."""

    first: str
    second: str
    task: str
    """The task, or `ALL_TASKS` for their mean."""
    measure: Measure
    margin: float | None
    contrast: Contrast
    pairs: Pairs = field(repr=False)
    """Pairs of conditions over which the difference is averaged."""
    asked: int = 0
    """Number of planned runs of both sides."""
    unfinished: int = 0
    """Number of planned runs of both sides that are neither finished nor failed."""
    p_value: float | None = None
    """Adjusted p-value of no difference; None for a comparison that was not planned."""
    p_equivalent: float | None = None
    """Adjusted p-value of no equivalence; None also without a margin."""
    verdict: Verdict = Verdict.NONE
    why: str = ""
    planned: bool = False
    """Whether it was planned before the first of its runs had finished."""
    hypothesis: Hypothesis | None = None

    @property
    def subject(self) -> tuple[object, ...]:
        """What is compared. Claims with the same subject differ only in their plan."""
        pairs = frozenset(frozenset(pair) for pair in self.pairs)
        return pairs, self.task, self.measure.kind, self.measure.metric

    def pair_among(self, claims: Sequence[Claim]) -> str:
        """`q = 1.5 against q = 1`, with the measure if `claims` on the task have several."""
        pair = f"{self.first} against {self.second}"
        several = len({one.measure.words for one in claims if one.task == self.task}) > 1
        return f"{pair}, {self.measure.words}" if several else pair

    @property
    def collapses(self) -> float | None:
        """Rate of collapses per seed that the verdict does not exclude; None if it is small."""
        rate = float(self.contrast.collapses)
        undecided = self.verdict in (Verdict.UNDECIDED, Verdict.NONE)
        return None if undecided or rate < COLLAPSES else rate

    @property
    def confirmed(self) -> bool | None:
        """Whether its hypothesis holds; None if it is undecided or nothing was expected."""
        expected = {
            "better than": Verdict.SUPERIOR,
            "worse than": Verdict.WORSE,
            "equivalent to": Verdict.EQUIVALENT,
        }.get(self.hypothesis.relation if self.hypothesis else "against")
        if expected is None or self.verdict in (Verdict.UNDECIDED, Verdict.NONE):
            return None
        return self.verdict is expected


def claims_of(
    sweep: Sweep,
    comparisons: Sequence[tuple[str, str, Pairs]],
    measures: Mapping[str, Measure],
    margin: float | None,
    seeds: int = 0,
) -> Iterator[Claim]:
    """Claims without a verdict, on each task and on all tasks if these have the same unit.

    Args:
        comparisons: Two labels each, and the pairs of conditions that they name.
        measures: Task to measure.
        margin: Margin of equivalence; None: the default for success rates.
        seeds: Number of planned seeds of each condition; 0 if unknown.
    """
    scopes = [(task, {task: one}) for task, one in measures.items()]
    if len(measures) > 1 and all(one.is_rate for one in measures.values()):
        scopes.insert(0, (ALL_TASKS, dict(measures)))
    for scope, own in scopes:
        measure, *others = own.values()
        if any(other.horizon != measure.horizon for other in others):
            measure = replace(measure, horizon=np.nan)
        if any(other.until != measure.until for other in others):
            measure = replace(measure, until={"": np.nan})
        # A margin of 1 or more can only be meant for returns.
        default = measure.metric == names.EVAL_SUCCESS and (margin is None or margin >= 1)
        own_margin = MARGIN_OF_A_RATE if default else margin
        for first, second, pairs in comparisons:
            sides = [
                [scores_of(sweep, pair[side], task, m) for pair in pairs for task, m in own.items()]
                for side in (0, 1)
            ]
            both = [one for side in sides for one in side]
            tested = _contrast(*sides, margin=own_margin)
            if tested is not None:
                yield Claim(
                    first=first,
                    second=second,
                    task=scope,
                    measure=measure,
                    margin=own_margin,
                    contrast=tested,
                    pairs=pairs,
                    asked=sum(max(one.runs, seeds) for one in both),
                    unfinished=sum(max(one.unfinished, seeds - len(one.by_seed)) for one in both),
                )


def _contrast(
    first: Sequence[Scores], second: Sequence[Scores], *, margin: float | None
) -> Contrast | None:
    """The contrast of two sides, each with scores for each task and each of several settings.

    The result is None if a side has no seed with all its scores.
    """
    sides = [_complete(first), _complete(second)]
    if not (sides[0] and sides[1]):
        return None
    paired = sides[0].keys() == sides[1].keys()
    if paired:
        sides[1] = {seed: sides[1][seed] for seed in sides[0]}
    x, y = (np.array(list(side.values())) for side in sides)
    variances = (
        sum(one.noise for one in columns) / len(columns) ** 2 / len(side)
        for columns, side in zip((first, second), sides, strict=True)
    )
    return contrast(x, y, paired=paired, margin=margin, noise=float(np.sqrt(sum(variances))))


def _complete(columns: Sequence[Scores]) -> dict[str, float]:
    """The mean score of each seed that has a score in every column."""
    seeds = [seed for seed in columns[0].by_seed if all(seed in c.by_seed for c in columns)]
    return {seed: float(np.mean([c.by_seed[seed] for c in columns])) for seed in seeds}


def decided(claims: Sequence[Claim], *, planned: bool, without_test: int = 0) -> tuple[Claim, ...]:
    """The claims with adjusted p-values and verdicts, as one family with those without a test.

    An unfinished claim counts with p = 1: its interim p-value must not help the others.
    """
    ended = [claim for claim in claims if not claim.unfinished]
    p_values = iter(
        adjusted(
            [claim.contrast.p_values for claim in ended], without_test + len(claims) - len(ended)
        )
    )
    found = []
    for claim in claims:
        none = None if claim.contrast.p_equivalent is None else 1.0
        p_value, p_equivalent = (1.0, none) if claim.unfinished else next(p_values)
        one = replace(claim, p_value=p_value, p_equivalent=p_equivalent, planned=planned)
        found.append(_decided(one))
    return tuple(found)


def exploratory(claims: Sequence[Claim]) -> tuple[Claim, ...]:
    """Claims outside the plan: without a verdict and without an adjusted p-value."""
    why = "exploratory: not in the plan"
    return tuple(replace(claim, why=claim.why or why) for claim in claims)


def _decided(claim: Claim) -> Claim:
    """The claim with its verdict, or with the reason for having none."""
    seeds = min(claim.contrast.seeds)
    if claim.unfinished:
        are = "is" if claim.unfinished == 1 else "are"
        runs = f"{claim.unfinished} of {claim.asked} planned runs {are} not finished"
        return replace(claim, why=runs)
    if seeds < FEWEST_SEEDS:
        count = "1 seed" if seeds == 1 else f"{seeds} seeds"
        return replace(claim, why=f"{count}: no verdict below {FEWEST_SEEDS}")
    if not claim.contrast.difference.has_interval:
        return replace(claim, why="all seeds tie: their spread is unknown")
    assert claim.p_value is not None
    value = float(claim.contrast.difference.value)
    sign = 1 if claim.measure.maximised else -1
    return replace(claim, verdict=verdict_of(sign * value, claim.p_value, claim.p_equivalent))
