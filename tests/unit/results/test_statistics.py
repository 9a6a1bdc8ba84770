"""Statistics against published numbers, other libraries and hand computation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from scipy import stats

from music_rllib.results import statistics as s

NAN = np.nan
# rliable, tests/rliable/metrics_test.py: runs x tasks.
X = np.array([[1.0, 2], [2, 2], [1, 1], [2, 1]])
Y = np.array([[1.0, 1], [2, 2], [3, 3]])

finite = st.floats(-1e3, 1e3)
matrices = st_numpy.arrays(float, st.tuples(st.integers(1, 7), st.integers(1, 4)), elements=finite)


def ends(found: s.Estimate) -> tuple[float, float, float]:
    return float(found.value), float(found.lower), float(found.upper)


def test_probability_of_improvement_equals_rliables() -> None:
    assert s.improvement(X, Y) == pytest.approx(1 / 3)
    assert s.improvement(Y, X) == pytest.approx(2 / 3)


@given(matrices, st.integers(0, 5))
def test_missing_runs_do_not_count(scores: np.ndarray, missing: int) -> None:
    padded = np.concatenate([scores, np.full((missing, scores.shape[1]), NAN)])
    ours, bare = s.estimate(padded), s.estimate(scores)
    for one, other in zip(ends(ours), ends(bare), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


@given(st_numpy.arrays(float, st.integers(2, 9), elements=finite, unique=True))
def test_an_unbounded_metric_has_students_interval(values: np.ndarray) -> None:
    expected = stats.ttest_1samp(values, 0).confidence_interval()
    assume(np.var(values) > 1e-6)
    found = s.estimate(values[:, np.newaxis])
    np.testing.assert_allclose(ends(found), (values.mean(), *expected), rtol=1e-6, atol=1e-6)


def test_tasks_are_strata() -> None:
    """The spread within each task counts, not the distance between tasks."""
    near, far = np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[0.0, 100.0], [1.0, 101.0]])
    a, b = s.estimate(near), s.estimate(far)
    assert b.value - a.value == 50
    # Two variances of 1/2 over two runs each: 1/8 of their mean, with two degrees of freedom.
    assert b.upper - b.value == pytest.approx(stats.t.ppf(0.975, 2) * np.sqrt(1 / 8))
    assert a.upper - a.value == pytest.approx(b.upper - b.value)
    # Only the task whose runs differ counts for the degrees of freedom.
    one = s.estimate(np.array([[0.0, 7.0], [1.0, 7.0]]))
    assert one.upper - one.value == pytest.approx(stats.t.ppf(0.975, 1) * np.sqrt(1 / 16))


@pytest.mark.parametrize("wins", [0, 75, 150])
def test_tied_seeds_have_the_exact_interval_over_their_episodes(wins: int) -> None:
    found = s.estimate(np.full((3, 1), wins / 150), episodes=50)
    exact = stats.binomtest(wins, 150).proportion_ci(0.95, method="exact")
    assert ends(found)[1:] == pytest.approx((exact.low, exact.high))
    assert not s.estimate(np.full((3, 1), wins / 150), episodes=np.inf).has_interval
    assert not s.estimate(np.full((3, 1), wins / 150)).has_interval


def test_the_interval_of_a_rate_follows_korn_and_graubard() -> None:
    """Seeds at 0.9, 1 and 0.8 have a variance of the mean of 1/300, that of 27 episodes, reduced
    by (1.96 / 4.303)^2."""
    trials = 27 * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, 2)) ** 2
    found = s.estimate(np.array([[0.9], [1.0], [0.8]]), episodes=50)
    low = stats.beta.ppf(0.025, 0.9 * trials, 0.1 * trials + 1)
    high = stats.beta.ppf(0.975, 0.9 * trials + 1, 0.1 * trials)
    assert ends(found) == pytest.approx((0.9, low, high))
    # The number of episodes is an upper limit.
    tight = s.estimate(np.array([[0.5], [0.5], [0.52]]), episodes=50)
    few = 150 * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, 2)) ** 2
    assert float(tight.lower) == pytest.approx(float(s.clopper_pearson(tight.value, few)[0]))


rates = st_numpy.arrays(
    float, st.tuples(st.integers(2, 7), st.integers(1, 3)), elements=st.integers(0, 20)
)


@given(rates)
def test_the_interval_of_a_rate_contains_it_and_stays_in_bounds(counts: np.ndarray) -> None:
    found = s.estimate(counts / 20, episodes=20)
    assert 0 <= found.lower <= found.value + 1e-9
    assert found.value - 1e-9 <= found.upper <= 1


def test_one_run_has_no_interval() -> None:
    single = s.estimate(np.array([[0.7, 0.8]]), episodes=50)
    assert single.value == pytest.approx(0.75)
    assert not single.has_interval
    some = s.estimate(np.array([[0.7, 0.8], [0.9, NAN]]))
    assert not some.has_interval  # the spread of the second task is unknown
    assert np.isnan(s.estimate(np.empty((0, 1))).value)


def test_a_curve_is_estimated_at_each_point_from_the_runs_present() -> None:
    curves = np.array([[0.0, 1.0, 2.0], [0.0, 3.0, NAN], [0.0, NAN, NAN]])[:, np.newaxis]
    found = s.estimate(curves)
    np.testing.assert_allclose(found.value, [0, 2, 2])
    half = stats.t.ppf(0.975, 1)
    np.testing.assert_allclose(found.lower, [NAN, 2 - half, NAN])
    np.testing.assert_allclose(found.upper, [NAN, 2 + half, NAN])


def test_the_interval_of_a_difference_combines_both() -> None:
    """Equal spreads: sqrt(2) times the half width; at a ceiling only the other side counts."""
    one, other = s.estimate(np.array([[1.0], [2], [3]])), s.estimate(np.array([[5.0], [6], [7]]))
    gap, half = s.difference(other, one), float(one.upper - one.value)
    assert ends(gap) == pytest.approx((4, 4 - np.sqrt(2) * half, 4 + np.sqrt(2) * half))
    top, below = s.estimate(np.ones((3, 1)), 50), s.estimate(np.array([[0.8], [0.9], [0.7]]), 50)
    gap = s.difference(top, below)
    assert gap.upper == pytest.approx(float(gap.value + below.value - below.lower))


def test_performance_profile() -> None:
    scores = np.array([[0.1, 0.5], [0.4, NAN], [0.5, 0.9]])
    found = s.performance_profile(scores, np.array([0.0, 0.4, 0.5, 0.9]))
    np.testing.assert_allclose(found.value, [1, 3 / 5, 1 / 5, 0])
    exact = stats.binomtest(3, 5).proportion_ci(0.95, method="exact")
    assert (found.lower[1], found.upper[1]) == pytest.approx((exact.low, exact.high))


# Times to a threshold ----------------------------------------------------------------------------


def median(steps: list[float], reached: list[bool]) -> tuple[float, float, float]:
    return ends(s.censored_median(np.array(steps, dtype=float), np.array(reached, dtype=bool)))


def test_first_passage() -> None:
    steps, values = np.array([1.0, 2, 3, 4]), np.array([0.2, NAN, 0.9, 0.5])
    assert s.first_passage(steps, values, 0.9) == (3, True)
    assert s.first_passage(steps, values, 0.95) == (4, False)
    assert s.first_passage(steps[:0], values[:0], 0.5) is None


def test_kaplan_meier_median_by_hand() -> None:
    """Freireich et al. 1963, the 6-MP arm of the leukemia trial: median 23 weeks."""
    weeks = [6, 6, 6, 7, 10, 13, 16, 22, 23, 6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    assert median([float(w) for w in weeks], [True] * 9 + [False] * 12)[0] == 23
    assert median([10, 20, 30, 40], [True, True, False, False])[0] == 20
    assert median([10, 40, 40, 40], [True, False, False, False])[0] == np.inf


def test_censored_runs_increase_the_median() -> None:
    assert median([10, 20, 30], [True] * 3)[0] == 20
    assert median([10, 20, 30, 100, 100], [True] * 3 + [False] * 2) == (30, 10, np.inf)
    # The run that was stopped at 5 may arrive last, so 10 is not the lower limit.
    assert median([5, 10, 20, 30, 40], [False] + [True] * 4)[1:] == (5, np.inf)


def test_the_interval_of_a_median_leaves_out_as_many_runs_as_possible() -> None:
    """The outermost of n runs are on one side of the median with probability 2 / 2^n."""
    steps = [float(step) for step in range(1, 13)]
    assert np.isnan(median(steps[:4], [True] * 4)[1:]).all()
    assert median(steps[:5], [True] * 5)[1:] == (1, 5)
    assert median(steps[:11], [True] * 11)[1:] == (3, 9)
    assert median(steps, [True] * 12)[1:] == (3, 10)


@pytest.mark.parametrize(
    ("value", "ends", "text"),
    [
        (0.7, (5.83e-42, 1.0), "0.70 [0.00, 1.00]"),
        (1.0, (0.964, 1.0), "1.00 [0.96, 1.00]"),
        (-458.0, (-3030.0, 2110.0), "-458 [-3,030, 2,110]"),
        (0.3004, (0.3, 0.301), "0.300 [0.300, 0.301]"),
        (-3030.0, None, "-3,030"),
    ],
)
def test_a_value_and_its_interval_have_the_same_decimals(
    value: float, ends: tuple[float, float] | None, text: str
) -> None:
    assert s.with_interval(value, ends) == text
