"""Numbers of rliable's own tests, of published tables, and computed by hand."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from scipy import stats

from music_rllib.results import statistics as s
from music_rllib.results.time_to_threshold import (
    Waits,
    first_passage,
    median_wait,
    median_wait_interval,
)

NAN = np.nan
# rliable, tests/rliable/metrics_test.py: runs x tasks.
X = np.array([[1.0, 2], [2, 2], [1, 1], [2, 1]])
Y = np.array([[1.0, 1], [2, 2], [3, 3]])

finite = st.floats(-1e3, 1e3)
matrices = st_numpy.arrays(float, st.tuples(st.integers(1, 7), st.integers(1, 4)), elements=finite)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def ends(found: s.Estimate) -> tuple[float, float, float]:
    return float(found.value), float(found.lower), float(found.upper)


def test_rliable_s_published_numbers(rng: np.random.Generator) -> None:
    assert s.estimate(X, rng).value == 1.5
    assert s.estimate(Y, rng).value == 2
    assert s.improvement(X, Y) == pytest.approx(1 / 3)
    assert s.improvement(Y, X) == pytest.approx(2 / 3)


@given(matrices)
def test_iqm_is_rliable_s_trimmed_mean(scores: np.ndarray) -> None:
    """rliable: scipy.stats.trim_mean(scores, proportiontocut=0.25, axis=None)."""
    expected = stats.trim_mean(scores, proportiontocut=0.25, axis=None)
    assert s.interquartile_mean(scores.ravel()) == pytest.approx(expected)


@given(matrices, st.integers(0, 5))
def test_a_run_that_does_not_exist_counts_for_nothing(scores: np.ndarray, missing: int) -> None:
    padded = np.concatenate([scores, np.full((missing, scores.shape[1]), NAN)])
    ours = s.estimate(padded, np.random.default_rng(0), resamples=50)
    bare = s.estimate(scores, np.random.default_rng(0), resamples=50)
    np.testing.assert_allclose(ours.value, bare.value)
    np.testing.assert_allclose(ours.lower, bare.lower)
    np.testing.assert_allclose(ours.upper, bare.upper)


@given(matrices, matrices)
def test_improvement_is_mann_and_whitney_s(x: np.ndarray, y: np.ndarray) -> None:
    tasks = min(x.shape[1], y.shape[1])
    x, y = x[:, :tasks], y[:, :tasks]
    u = [stats.mannwhitneyu(x[:, t], y[:, t]).statistic for t in range(tasks)]
    assert s.improvement(x, y) == pytest.approx(np.mean(u) / (len(x) * len(y)))


def test_every_resample_of_two_runs(rng: np.random.Generator) -> None:
    """Runs 0 and 1 give the means 0, 1/2, 1/2, 1: the ends are 0 and 1. A pooled bootstrap of
    the two tasks would mix 0..1 with 10..11."""
    one = s.estimate(np.array([[0.0], [1.0]]), rng)
    assert ends(one) == (0.5, 0.0, 1.0)
    two = s.estimate(np.array([[0.0, 10.0], [1.0, 11.0]]), rng, s.mean)
    assert ends(two) == (5.5, 5.0, 6.0)


def test_interval_covers_as_often_as_it_says(rng: np.random.Generator) -> None:
    """Mean of 30 normal runs: 95 %, a little less for a percentile bootstrap of 30."""
    covered = 0
    for _ in range(300):
        found = s.estimate(rng.normal(size=(30, 1)), rng, s.mean, resamples=300)
        covered += bool(found.lower <= 0 <= found.upper)
    assert 0.89 <= covered / 300 <= 0.98


def test_one_run_has_no_interval(rng: np.random.Generator) -> None:
    single = s.estimate(np.array([[0.7, 0.8]]), rng)
    assert single.value == pytest.approx(0.75)
    assert not single.has_interval
    some = s.estimate(np.array([[0.7, 0.8], [0.9, NAN]]), rng)
    assert not some.has_interval  # the second task's spread is not known
    assert np.isnan(s.estimate(np.empty((0, 1)), rng).value)
    assert not s.probability_of_improvement(X[:1], Y, rng).has_interval


def test_a_curve_is_estimated_point_by_point_with_the_runs_that_are_there(
    rng: np.random.Generator,
) -> None:
    curves = np.array([[0.0, 1.0, 2.0], [0.0, 3.0, NAN], [0.0, NAN, NAN]])[:, np.newaxis]
    found = s.estimate(curves, rng)
    np.testing.assert_allclose(found.value, [0, 2, 2])
    assert (found.lower[0], found.upper[0]) == (0, 0)
    assert (found.lower[1], found.upper[1]) == (1, 3)
    assert np.isnan(found.lower[2])


def test_curves_in_small_parts_are_the_same_estimate(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    curves = rng.random((8, 2, 5))
    whole = s.estimate(curves, rng)
    monkeypatch.setattr(s, "_CHUNK", 1000)
    parts = s.estimate(curves, rng)
    np.testing.assert_allclose(whole.lower, parts.lower, atol=0.05)
    np.testing.assert_allclose(whole.upper, parts.upper, atol=0.05)


def test_profile(rng: np.random.Generator) -> None:
    scores = np.array([[0.1, 0.5], [0.4, NAN], [0.5, 0.9]])
    found = s.performance_profile(scores, np.array([0.0, 0.4, 0.5, 0.9]), rng)
    np.testing.assert_allclose(found.value, [1, 3 / 5, 1 / 5, 0])
    assert np.all(found.lower <= found.value)
    assert np.all(found.value <= found.upper)


def test_probability_of_improvement_of_clear_and_of_equal_runs(rng: np.random.Generator) -> None:
    low, high = np.array([[0.1], [0.2], [0.3]]), np.array([[0.8], [0.9]])
    clear = s.probability_of_improvement(high, low, rng)
    assert ends(clear) == (1, 1, 1)
    same = s.probability_of_improvement(low, low, rng)
    assert same.value == 0.5
    assert same.lower < 0.5 < same.upper


def test_p_value_is_that_of_all_relabellings(rng: np.random.Generator) -> None:
    x, y = np.array([3.0, 4, 7, 9]), np.array([1.0, 2, 3, 5])
    pooled = np.concatenate([x, y])
    observed = abs(s.improvement(x[:, None], y[:, None]) - 0.5)
    extreme = []
    for chosen in combinations(range(8), 4):
        rest = [index for index in range(8) if index not in chosen]
        p = s.improvement(pooled[list(chosen), None], pooled[rest, None])
        extreme.append(abs(p - 0.5) >= observed - 1e-12)
    ours = s.improvement_p_value(x[:, None], y[:, None], rng)
    assert ours == pytest.approx(np.mean(extreme), abs=0.015)


def test_few_runs_are_never_evidence(rng: np.random.Generator) -> None:
    """3 against 3, completely apart: 2 of 20 relabellings are as extreme."""
    low, high = np.arange(3.0)[:, None], 10 + np.arange(3.0)[:, None]
    assert s.improvement_p_value(high, low, rng) == pytest.approx(0.1, abs=0.01)
    both = np.concatenate([low, low], axis=1), np.concatenate([high, high], axis=1)
    assert s.improvement_p_value(*both, rng) == pytest.approx(2 / 400, abs=0.003)


def test_holm() -> None:
    assert s.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert s.holm([0.9, 0.8]) == [1.0, 1.0]
    assert s.holm([]) == []


@pytest.mark.parametrize("effect, seeds", [(0.2, 394), (0.5, 64), (0.8, 26), (1.0, 17)])
def test_seeds_are_those_of_cohen_s_table(effect: float, seeds: int) -> None:
    """Cohen 1988, two-sided .05, power .8 (394 by the exact t distribution, his table says 393)."""
    assert s.seeds_to_decide(effect * 0.3, 0.3) == seeds
    assert s.power_of(seeds, effect, 1.0) >= 0.8 > s.power_of(seeds - 1, effect, 1.0)


def test_seeds_against_a_simulated_experiment(rng: np.random.Generator) -> None:
    """Three tasks, each difference averaged; a t test on the averaged difference."""
    x, y = rng.normal(0.0, 1.0, (4000, 9, 3)), rng.normal(0.8, 1.0, (4000, 9, 3))
    difference = y.mean(axis=(1, 2)) - x.mean(axis=(1, 2))
    spread = np.sqrt((x.var(axis=1, ddof=1) + y.var(axis=1, ddof=1)).mean(axis=1) / 2)
    t = difference / (spread * np.sqrt(2 / 27))
    seen = np.mean(np.abs(t) > stats.t.ppf(0.975, 48))
    assert s.power_of(9, 0.8, 1.0, tasks=3) == pytest.approx(seen, abs=0.02)
    assert s.seeds_to_decide(0.8, 1.0, tasks=3) == 9


def test_seeds_beyond_reach_and_nonsense() -> None:
    assert s.seeds_to_decide(0.001, 1.0) is None
    assert s.seeds_to_decide(50.0, 0.01) == 2
    with pytest.raises(ValueError, match=r"spread must be > 0, got 0\.0"):
        s.seeds_to_decide(0.1, 0.0)
    with pytest.raises(ValueError, match="difference must be > 0"):
        s.seeds_to_decide(NAN, 1.0)


def test_pooled_spread() -> None:
    """Squares 2 + 2 + 0 over 1 + 2 + 0 degrees of freedom."""
    groups = [np.array([[0.0, 5.0], [2.0, NAN]]), np.array([[10.0], [11.0], [12.0]])]
    assert s.pooled_spread(groups) == pytest.approx(np.sqrt(4 / 3))
    assert s.pooled_spread([np.array([[1.0]])]) is None


def test_tasks_must_match() -> None:
    with pytest.raises(ValueError, match="same tasks, got 2 and 1"):
        s.improvement(X, Y[:, :1])
    with pytest.raises(ValueError, match="task 0 has none"):
        s.improvement(np.array([[NAN]]), np.array([[1.0]]))


# Steps to a threshold ---------------------------------------------------------------------------


def waits(steps: list[float], reached: list[bool]) -> Waits:
    return Waits(steps=np.array(steps, dtype=float), reached=np.array(reached, dtype=bool))


def test_first_passage() -> None:
    steps, values = np.array([1.0, 2, 3, 4]), np.array([0.2, NAN, 0.9, 0.5])
    assert first_passage(steps, values, 0.9) == (3, True)
    assert first_passage(steps, values, 0.95) == (4, False)
    assert first_passage(steps[:0], values[:0], 0.5) is None


def test_kaplan_and_meier_by_hand() -> None:
    """Freireich et al. 1963, the 6-MP arm of the leukaemia trial: median 23 weeks."""
    weeks = [6, 6, 6, 7, 10, 13, 16, 22, 23, 6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    assert median_wait(waits([float(w) for w in weeks], [True] * 9 + [False] * 12)) == 23
    assert median_wait(waits([10, 20, 30, 40], [True, True, False, False])) == 20
    assert median_wait(waits([10, 40, 40, 40], [True, False, False, False])) == np.inf
    assert np.isnan(median_wait(waits([], [])))


def test_runs_that_never_arrive_make_it_slower_and_not_faster(rng: np.random.Generator) -> None:
    arrived = waits([10, 20, 30], [True] * 3)
    with_lost = waits([10, 20, 30, 100, 100], [True] * 3 + [False] * 2)
    assert median_wait(arrived) == 20
    assert median_wait(with_lost) == 30
    lower, upper = median_wait_interval(with_lost, rng)
    assert lower in (10, 20)
    assert upper == np.inf
    assert median_wait_interval(arrived, rng) == (10, 30)
    assert all(np.isnan(median_wait_interval(waits([1], [True]), rng)))
