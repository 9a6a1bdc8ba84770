"""Comparisons of steps to a threshold: with known orders, and with Mann and Whitney's test."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from music_rllib import names
from music_rllib.results.data import Points, RunRecord, Sweep, columns
from music_rllib.results.time_to_threshold import Race, races

BUDGET = 10
Runs = list[tuple[str, int | None]]
"""Status, and the step at which 0.9 is reached, or None."""


def sweep_of(runs: Runs) -> Sweep:
    records = [
        RunRecord(run_id="", name="", status=status, tags={names.TAG_TASK: "Push"})
        for status, _ in runs
    ]
    steps = list(range(BUDGET + 1))
    curves = [[1.0 if at is not None and step >= at else 0.0 for step in steps] for _, at in runs]
    points = [
        Points([names.EVAL_SUCCESS] * len(steps), steps, [0] * len(steps), curve)
        for curve in curves
    ]
    return Sweep(name="n", runs=records, history=columns(points))


def race(first: Runs, second: Runs) -> tuple[Race, ...]:
    groups = {"second": range(len(second)), "first": range(len(second), len(second + first))}
    return races(sweep_of([*second, *first]), "Push", groups, 0.9)


def finished(*at: int | None) -> Runs:
    return [("FINISHED", step) for step in at]


@given(*[st.lists(st.none() | st.integers(0, BUDGET), min_size=1, max_size=6)] * 2)
def test_it_is_mann_and_whitney_s_with_those_who_never_arrive_last(
    x: list[int | None], y: list[int | None]
) -> None:
    (found,) = race(finished(*x), finished(*y))
    a, b = ([-BUDGET - 1 if at is None else -at for at in arrivals] for arrivals in (x, y))
    u = stats.mannwhitneyu(a, b).statistic
    assert float(found.estimate.value) == pytest.approx(u / (len(x) * len(y)))
    assert (found.first, found.second, found.runs) == ("first", "second", (len(x), len(y)))


def test_five_clear_seeds_decide_and_three_cannot() -> None:
    (found,) = race(finished(1, 2, 3, 2, 1), finished(8, 9, None, 7, 8))
    assert found.decided
    assert float(found.estimate.value) == 1.0
    (few,) = race(finished(1, 2, 3), finished(8, 9, None))
    assert not few.decided


def test_where_nobody_gets_there_nothing_is_compared() -> None:
    (found,) = race(finished(None, None), finished(None, None, None))
    assert (found.reached, found.decided, found.p_value) == (False, False, 1.0)
    (found,) = race(finished(None, None), finished(None, 3))
    assert found.reached
    # Five runs against five all apart, and a third group with no bearing on them: one comparison.
    runs = [*finished(*[None] * 10), *finished(1, 1, 1, 1, 1)]
    groups = {"a": range(5), "b": range(5, 10), "c": range(10, 15)}
    by_pair = {(r.first, r.second): r.p_value for r in races(sweep_of(runs), "Push", groups, 0.9)}
    assert by_pair == pytest.approx({("b", "a"): 1.0, ("c", "a"): 4 / 252, ("c", "b"): 4 / 252})


def test_a_run_that_may_still_get_there_says_nothing() -> None:
    (found,) = race([*finished(3), ("RUNNING", None), ("FAILED", None)], finished(5))
    assert found.runs == (1, 1)
    (found,) = race([*finished(3), ("RUNNING", 2), ("FAILED", 1)], finished(5))
    assert found.runs == (1, 1), "of runs that were stopped early only the quick ones are there"
    assert race([("RUNNING", None)], finished(5)) == ()


def test_runs_of_another_length_race_over_the_smaller_budget() -> None:
    """A longer run is there at the end; at the other's end neither was."""
    long = finished(*[BUDGET] * 6)
    sweep = sweep_of([*long, *finished(*[None] * 6)])
    half = BUDGET // 2
    sweep = replace(
        sweep,
        runs=[replace(run, params={"env_steps": str(BUDGET)}) for run in sweep.runs[:6]]
        + [replace(run, params={"env_steps": str(half)}) for run in sweep.runs[6:]],
        history={
            metric: column.select((column.run < 6) | (column.step <= half))
            for metric, column in sweep.history.items()
        },
    )
    (found,) = races(sweep, "Push", {"long": range(6), "short": range(6, 12)}, 0.9)
    assert not found.reached
    assert float(found.estimate.value) == 0.5


def test_who_arrives_in_the_last_round_that_ends_behind_the_budget_has_arrived() -> None:
    sweep = sweep_of(finished(*[BUDGET] * 6, *[None] * 6))
    params = {"env_steps": str(BUDGET - 1)}
    sweep = replace(sweep, runs=[replace(run, params=params) for run in sweep.runs])
    (found,) = races(sweep, "Push", {"late": range(6), "never": range(6, 12)}, 0.9)
    assert (found.reached, found.decided) == (True, True)


def test_only_the_task_s_own_runs_race() -> None:
    sweep = sweep_of(finished(1, 2))
    assert races(sweep, "Slide", {"a": [0], "b": [1]}, 0.9) == ()
