"""Schedules: their values, their ends, and mistakes."""

import math
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from music_rllib.schedules import (
    AdaptiveSchedule,
    Follower,
    Linear,
    Measured,
    Piecewise,
    Quantity,
    Schedule,
    bounded,
    extremes,
    value_at,
)

schedule = TypeAdapter(Schedule)
adaptive = TypeAdapter(AdaptiveSchedule)
positive = TypeAdapter(Annotated[Schedule, bounded("> 0", lambda value: value > 0)])


def test_the_curriculum_of_the_tac_authors() -> None:
    curriculum = Linear(start=1.0, end=2.0)
    at = [value_at(curriculum, step, 1000) for step in (0, 100, 500, 900, 1000, 5000)]
    assert at == pytest.approx([1.0, 1.0, 1.5, 2.0, 2.0, 2.0])


def test_piecewise_interpolates_or_holds_and_keeps_its_last_value() -> None:
    points = ((0, 1.0), (100, 0.5), (200, 0.0))
    line, steps = Piecewise(points=points), Piecewise(points=points, interpolation="hold")
    assert [value_at(line, n, 0) for n in (0, 50, 100, 150, 200, 10**9)] == pytest.approx(
        [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]
    )
    assert [value_at(steps, n, 0) for n in (0, 99, 100, 199, 200)] == [1.0, 1.0, 0.5, 0.5, 0.0]


@given(
    start=st.floats(-5, 5),
    end=st.floats(-5, 5),
    step=st.integers(0, 2000),
)
def test_a_schedule_stays_between_its_extremes(start: float, end: float, step: int) -> None:
    points = ((0, start), (700, end), (2000, start))
    for made in (Linear(start=start, end=end), Piecewise(points=points)):
        low, high = extremes(made)
        assert low <= value_at(made, step, 1000) <= high
        assert value_at(made, 0, 1000) == start
    assert value_at(Linear(start=start, end=end), 900 + step, 1000) == end


def follower(follows: Quantity = "success_rate", **settings: object) -> tuple[Measured, Follower]:
    points = [[0.2, 2.0], [0.6, 1.0], [0.8, 1.5]]
    made: Any = adaptive.validate_python({"follows": follows, "points": points, **settings})
    return made, Follower(made)


def test_a_measured_value_lies_on_lines_between_its_points() -> None:
    made, _ = follower()
    at = [value_at(made, 10**6, 0, rate) for rate in (None, 0.0, 0.2, 0.4, 0.6, 0.7, 1.0)]
    assert at == pytest.approx([2.0, 2.0, 2.0, 1.5, 1.0, 1.25, 1.5])
    assert extremes(made) == (1.0, 2.0)
    of_entropy, _ = follower("shannon_entropy")
    before = value_at(of_entropy, 10**6, 0, None)
    assert before == 1.5, "before the first update a policy is as random as ever"


def test_smoothing_weights_measurements_by_their_age() -> None:
    made, one = follower(smoothing=1000.0)
    one.observe("success_rate", 0.4, 5000)
    one.observe("shannon_entropy", -9.0, 5500)
    one.observe("success_rate", 1.0, 6000)
    kept = math.exp(-1.0)
    assert one.measured == pytest.approx(0.4 * kept + 1.0 * (1 - kept))
    resumed = Follower(made)
    resumed.load_state(one.state())
    for each in (one, resumed):
        each.observe("success_rate", 0.1, 7000)
    assert resumed.measured == one.measured


@given(
    rounds=st.lists(st.lists(st.floats(-5, 5), min_size=1, max_size=4), min_size=1, max_size=6),
    cut=st.integers(0, 20),
)
def test_smoothing_uses_the_mean_of_each_round(rounds: list[list[float]], cut: int) -> None:
    made, one = follower("shannon_entropy", smoothing=300.0)
    seen, expected = 0, None
    for number, measured in enumerate(rounds):
        for value in measured:
            if seen == cut:  # a run that resumes in the middle of a round
                state, one = one.state(), Follower(made)
                one.load_state(state)
            one.observe("shannon_entropy", value, 200 * number)
            seen += 1
        mean, kept = sum(measured) / len(measured), math.exp(-200 / 300)
        expected = mean if expected is None else kept * expected + (1 - kept) * mean
        assert one.measured == pytest.approx(expected)


@pytest.mark.parametrize(("follows", "best"), [("success_rate", max), ("shannon_entropy", min)])
@given(seen=st.lists(st.floats(-3, 3), min_size=1))
def test_a_monotone_value_never_goes_back(follows: Quantity, best: Any, seen: list[float]) -> None:
    _, one = follower(follows, monotone=True)
    for step, measured in enumerate(seen):
        one.observe(follows, measured, step)
        one.observe(follows, math.nan, step)
        assert one.measured == best(seen[: step + 1])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"follows": "return", "points": [[0, 1], [1, 2]]}, "'success_rate' or 'shannon_entropy'"),
        ({"follows": "success_rate", "points": [[0, 1]]}, "at least 2 items"),
        (
            {"follows": "success_rate", "points": [[0.5, 1], [0.5, 2]]},
            r"must rise strictly in what is measured, got \[0.5, 0.5\]",
        ),
        (
            {"follows": "success_rate", "points": [[20, 2], [90, 1]]},
            r"points of a success rate must lie in \[0, 1\], got \[20.0, 90.0\]",
        ),
        ({"start": 1}, "'schedule: linear', 'schedule: piecewise' or 'follows'"),
    ],
)
def test_an_invalid_measured_schedule_has_one_error(value: object, message: str) -> None:
    with pytest.raises(ValidationError, match=message) as caught:
        adaptive.validate_python(value)
    assert caught.value.error_count() == 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (True, "valid number"),
        ("1.5", "valid number"),
        (float("nan"), "finite"),
        ({"start": 1}, "must be a number, or have 'schedule: linear'"),
        (
            {"schedule": "linear", "start": 1, "end": 2, "begin": 0.9, "finish": 0.1},
            "begin must be",
        ),
        (
            {"follows": "success_rate", "points": [[0, 1], [1, 2]]},
            "must be a number, or have 'schedule: linear'",
        ),
        ({"schedule": "piecewise", "points": [[5, 1.0]]}, "must begin at env step 0, got 5"),
        ({"schedule": "piecewise", "points": [[0, 1.0], [0, 2.0]]}, "strictly increasing"),
        ({"schedule": "linear", "start": 1, "end": 2, "stop": 3}, "Extra inputs"),
    ],
)
def test_an_invalid_schedule_has_one_error(value: object, message: str) -> None:
    with pytest.raises(ValidationError, match=message) as caught:
        schedule.validate_python(value)
    assert caught.value.error_count() == 1


def test_bounds_hold_over_the_whole_schedule() -> None:
    positive.validate_python({"schedule": "linear", "start": 1.0, "end": 0.1})
    with pytest.raises(ValidationError, match="must be > 0, got 0"):
        positive.validate_python({"schedule": "linear", "start": 1.0, "end": 0.0})
    with pytest.raises(ValidationError, match="must be > 0, got -1"):
        positive.validate_python(-1)
