"""Error rates of comparisons, by simulation, and agreement with scipy's tests."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from scipy import stats

from benchmarks import decisions
from music_rllib.results import claims as c
from music_rllib.results import statistics as s
from music_rllib.results.claims import Verdict
from music_rllib.results.scores import area_under_curve
from music_rllib.results.statistics import Array

DRAWS = 4000
SPREAD, MARGIN = 0.06, 0.05
NOISE = 3 * np.sqrt(0.05 * 0.95 / DRAWS)
"""Three standard errors of a rate of 5%."""

Study = tuple[Array, Array]


def study(effect: float, seeds: int, rng: np.random.Generator, *, paired: bool) -> Study:
    """Mean success over the budget of two conditions that share their seeds, `[seeds, draws]`.

    Each is a mean of 20 evaluations of 50 episodes, around curves that differ in height.
    """
    common = rng.normal(0.55, 0.05, (seeds, DRAWS))
    own = rng.normal(0, SPREAD / np.sqrt(2), (2, seeds, DRAWS))
    other = common if paired else rng.normal(0.55, 0.05, (seeds, DRAWS))
    rates = np.clip(np.stack([common + own[0] + effect, other + own[1]]), 0, 1)
    x, y = rng.binomial(1000, rates) / 1000
    return x, y


def verdicts(found: c.Contrast) -> dict[Verdict, float]:
    """Share of each verdict among single comparisons."""
    assert found.p_equivalent is not None
    triples = zip(found.difference.value, found.p_value, found.p_equivalent, strict=True)
    decided = [c.verdict_of(*map(float, triple)) for triple in triples]
    return {verdict: decided.count(verdict) / len(decided) for verdict in Verdict}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("seeds", [3, 5, 10])
def test_error_rates_and_coverage_are_nominal(
    seeds: int, paired: bool, rng: np.random.Generator
) -> None:
    none = c.contrast(*study(0.0, seeds, rng, paired=paired), paired=paired, margin=MARGIN)
    covers = (none.difference.lower <= 0) & (none.difference.upper >= 0)
    assert abs(np.mean(none.p_value < 0.05) - 0.05) < NOISE + 0.01
    assert abs(np.mean(covers) - 0.95) < NOISE + 0.01
    # A difference equal to the margin counts as equivalent in 5% of studies.
    edge = c.contrast(*study(MARGIN, seeds, rng, paired=paired), paired=paired, margin=MARGIN)
    assert edge.p_equivalent is not None
    assert np.mean(edge.p_equivalent < 0.05) < 0.05 + NOISE


def test_planned_seeds_detect_a_planted_effect(rng: np.random.Generator) -> None:
    """80% of studies with the planned number of seeds are right."""
    spread = float(np.hypot(SPREAD, np.sqrt(2 * 0.25 / 1000)))  # with the noise of the evaluations
    seeds = s.seeds_needed(0.1, spread, paired=True)[0]
    assert seeds is not None
    better = c.contrast(*study(0.1, seeds, rng, paired=True), paired=True, margin=MARGIN)
    assert verdicts(better)[Verdict.SUPERIOR] == pytest.approx(0.84, abs=0.05)
    assert verdicts(better)[Verdict.WORSE] + verdicts(better)[Verdict.EQUIVALENT] < 0.002
    worse = c.contrast(*study(-0.1, seeds, rng, paired=True), paired=True, margin=MARGIN)
    assert verdicts(worse)[Verdict.WORSE] == pytest.approx(0.84, abs=0.05)
    seeds = s.seeds_needed(MARGIN, spread, paired=True)[1]
    assert seeds is not None
    same = c.contrast(*study(0.0, seeds, rng, paired=True), paired=True, margin=MARGIN)
    assert verdicts(same)[Verdict.EQUIVALENT] == pytest.approx(0.82, abs=0.04)
    few = c.contrast(*study(0.0, 3, rng, paired=True), paired=True, margin=MARGIN)
    assert verdicts(few)[Verdict.UNDECIDED] > 0.85


@pytest.mark.parametrize("truths", [[0.0] * 3, [0.0, MARGIN]])
def test_a_family_has_a_wrong_verdict_in_at_most_5_percent(
    truths: list[float],
) -> None:
    """Also if some comparisons have no difference and others a difference of the margin."""
    wrong = decisions.wrong_in_a_family(np.array(truths), 8, 0.05, 2000)
    assert wrong < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)


def test_adjusted_p_values_without_equivalence_are_holms() -> None:
    rng = np.random.default_rng(1)
    found = [c.contrast(rng.normal(size=6), np.zeros(6), paired=True) for _ in range(5)]
    rising = sorted(float(one.p_value) for one in found)
    steps = np.maximum.accumulate([(5 - rank) * p for rank, p in enumerate(rising)])
    adjusted = sorted(p for p, _ in c.adjusted([one.p_values for one in found]))
    assert adjusted == pytest.approx(np.minimum(1.0, steps).tolist())
    assert c.adjusted([found[0].p_values], without_test=2)[0][0] == pytest.approx(
        min(1.0, 3 * float(found[0].p_value))
    )


@pytest.mark.parametrize("setting", decisions.SETTINGS, ids=lambda one: one.name)
def test_a_wrong_verdict_is_rare_or_states_collapses_that_are_not_excluded(
    setting: decisions.Setting,
) -> None:
    noise = 3 * np.sqrt(0.08 * 0.92 / DRAWS)
    for seeds in (10, 20, 30):
        assert decisions.rate(setting, decisions.silent, seeds, DRAWS) < 0.08 + noise


def test_more_seeds_exclude_rarer_collapses() -> None:
    def rates(seeds: int, collapsed: int) -> float:
        scores = np.linspace(0.5, 0.6, seeds)
        scores[:collapsed] = 0.0
        return float(c.contrast(scores, np.zeros(seeds), paired=True).collapses)

    assert rates(10, 0) == pytest.approx(1 - 0.2 ** (1 / 10))
    assert rates(6, 0) > rates(20, 0) > rates(40, 0)
    assert rates(20, 1) > rates(20, 0)


scores_of_seeds = st_numpy.arrays(
    float, st.tuples(st.just(2), st.integers(2, 9)), elements=st.integers(0, 50)
).map(lambda counts: counts / 50)


@given(scores_of_seeds, st.booleans(), st.sampled_from([0.0, 0.01]), st.floats(0.01, 0.5))
def test_intervals_and_p_values_agree(
    scores: Array, paired: bool, noise: float, margin: float
) -> None:
    found = c.contrast(*scores, paired=paired, noise=noise, margin=margin)
    assert found.p_equivalent is not None
    if not found.difference.has_interval:
        assert (float(found.p_value), float(found.p_equivalent)) == (1.0, 1.0)
        return
    p_value, p_equivalent = float(found.p_value), float(found.p_equivalent)
    if abs(p_value - 0.05) > 1e-9:
        excluded = found.difference.lower > 0 or found.difference.upper < 0
        assert bool(excluded) == (p_value < 0.05)
    if abs(p_equivalent - 0.05) > 1e-9:
        inside = -margin < found.within.lower and found.within.upper < margin
        assert bool(inside) == (p_equivalent < 0.05)


def test_tied_seeds_are_as_uncertain_as_their_episodes() -> None:
    """Seeds that all succeed are stronger evidence than seeds with one lost episode."""
    noise = 0.008  # six seeds of 50 episodes on each side
    ones, lost = np.ones(6), np.array([1, 1, 1, 1, 1, 0.98])
    tied, near = (
        c.contrast(x, ones, paired=True, margin=MARGIN, noise=noise) for x in (ones, lost)
    )
    assert tied.p_equivalent is not None
    assert near.p_equivalent is not None
    assert float(tied.p_equivalent) < float(near.p_equivalent) < 0.05
    almost = c.contrast(
        np.append(ones[1:], 1 + 1e-9), ones, paired=True, margin=MARGIN, noise=noise
    )
    assert float(tied.p_equivalent) == pytest.approx(almost.p_equivalent)
    # Without episodes their uncertainty is unknown.
    assert not c.contrast(ones, 0 * ones, paired=True).difference.has_interval


@pytest.mark.parametrize("m, n, paired", [(5, 5, True), (5, 3, False), (2, 2, False)])
def test_p_values_and_intervals_equal_scipys(
    m: int, n: int, paired: bool, rng: np.random.Generator
) -> None:
    x, y = rng.normal(0.7, 0.2, (m, 50)), rng.normal(0.6, 0.1, (n, 50))
    found = c.contrast(x, y, paired=paired, margin=0.2)
    run = stats.ttest_rel if paired else partial(stats.ttest_ind, equal_var=False)
    np.testing.assert_allclose(found.p_value, run(x, y).pvalue)
    ends = run(x, y).confidence_interval(0.95)
    np.testing.assert_allclose([found.difference.lower, found.difference.upper], ends)
    sides = run(x + 0.2, y, alternative="greater"), run(x - 0.2, y, alternative="less")
    np.testing.assert_allclose(found.p_equivalent, np.max([s.pvalue for s in sides], axis=0))  # type: ignore[arg-type]


def test_a_single_seed_has_no_interval() -> None:
    found = c.contrast(np.array([0.9]), np.array([0.1]), paired=True, margin=MARGIN)
    assert c.adjusted([found.p_values]) == [(1.0, 1.0)]
    assert not found.difference.has_interval


pairs = st_numpy.arrays(
    float, st.tuples(st.just(2), st.integers(2, 9)), elements=st.integers(0, 100)
).map(lambda counts: counts / 100)


@given(pairs, st.booleans(), st.floats(0.01, 0.5))
def test_swapping_the_sides_negates_the_difference(
    scores: Array, paired: bool, margin: float
) -> None:
    x, y = scores
    one, other = (c.contrast(*s, paired=paired, margin=margin) for s in ((x, y), (y, x)))
    np.testing.assert_allclose(one.difference.value, -other.difference.value)
    np.testing.assert_allclose(one.difference.lower, -other.difference.upper, atol=1e-9)
    np.testing.assert_allclose(one.p_value, other.p_value, rtol=1e-6)
    assert one.p_equivalent is not None
    assert other.p_equivalent is not None
    np.testing.assert_allclose(one.p_equivalent, other.p_equivalent, rtol=1e-6)


# Area under the curve -----------------------------------------------------------------------------


def test_area_under_the_curve_by_hand() -> None:
    steps, values = np.array([100.0, 200.0, 300.0]), np.array([0.0, 0.5, 1.0])
    assert area_under_curve(steps, values, 300) == pytest.approx((0 + 25 + 75) / 300)
    # Cut between two evaluations: the line is at 0.75 at step 250.
    assert area_under_curve(steps, values, 250) == pytest.approx((25 + 50 * 0.625) / 250)
    # An evaluation before the first step counts.
    assert area_under_curve(np.array([0.0, 10.0]), np.array([1.0, 0.0]), 10) == pytest.approx(0.5)
    assert np.isnan(area_under_curve(steps, values, 301))
    assert np.isnan(area_under_curve(steps[:0], values[:0], 1))


curves = st.lists(
    st.tuples(st.integers(0, 1000), st.floats(0, 1)), min_size=1, unique_by=lambda p: p[0]
)


@given(curves, st.floats(-2, 2), st.integers(1, 1000))
def test_area_under_the_curve_is_a_mean(
    points: list[tuple[int, float]], shift: float, horizon: int
) -> None:
    steps, values = (np.array(part, float) for part in zip(*sorted(points), strict=True))
    found = area_under_curve(steps, values, horizon)
    if steps[-1] < horizon:
        assert np.isnan(found)
        return
    assert values.min() - 1e-9 <= found <= values.max() + 1e-9
    assert area_under_curve(steps, values + shift, horizon) == pytest.approx(found + shift)
    assert area_under_curve(steps * 7, values, horizon * 7) == pytest.approx(found)
