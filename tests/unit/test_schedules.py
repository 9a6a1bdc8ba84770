"""Schedules: their values, how they end, and what they refuse."""

from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from music_rllib.schedules import Linear, Piecewise, Schedule, bounded, extremes, value_at

schedule = TypeAdapter(Schedule)
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
    ramp = Linear(start=start, end=end)
    low, high = extremes(ramp)
    assert low - 1e-9 <= value_at(ramp, step, 1000) <= high + 1e-9


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
        ({"schedule": "piecewise", "points": [[5, 1.0]]}, "must begin at env step 0, got 5"),
        ({"schedule": "piecewise", "points": [[0, 1.0], [0, 2.0]]}, "strictly increasing"),
        ({"schedule": "linear", "start": 1, "end": 2, "stop": 3}, "Extra inputs"),
    ],
)
def test_bad_schedules_give_exactly_one_error(value: object, message: str) -> None:
    with pytest.raises(ValidationError, match=message) as caught:
        schedule.validate_python(value)
    assert caught.value.error_count() == 1


def test_bounds_hold_over_the_whole_schedule() -> None:
    positive.validate_python({"schedule": "linear", "start": 1.0, "end": 0.1})
    with pytest.raises(ValidationError, match="must be > 0, got 0"):
        positive.validate_python({"schedule": "linear", "start": 1.0, "end": 0.0})
    with pytest.raises(ValidationError, match="must be > 0, got -1"):
        positive.validate_python(-1)
