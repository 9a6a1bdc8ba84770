"""NaN, infinity and absurd numbers from an environment go no further than where they come in."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from music_rllib.envs.episodes import Recording
from music_rllib.envs.values import LARGEST, BadNumberError, are_usable, check_numbers
from music_rllib.replay.trajectories import ReplayLayout

BAD = st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 2 * LARGEST])
SOUND = st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=80)
LAYOUT = ReplayLayout(observation=5, action=2, goal=2, horizon=4)


@given(values=SOUND)
def test_what_can_be_learned_from_passes(values: list[float]) -> None:
    assert are_usable(np.array(values, np.float32))
    check_numbers("observation", values)


@given(values=SOUND, bad=BAD, data=st.data())
def test_one_bad_number_among_any_others_is_found_and_named(
    values: list[float], bad: float, data: st.DataObject
) -> None:
    place = data.draw(st.integers(0, len(values) - 1))
    values[place] = bad
    assert not are_usable(np.array(values, np.float32))
    with pytest.raises(ValueError, match="every number must be finite") as caught:
        check_numbers("observation", values)
    message = f"observation[{place}] is {bad:g}, every number"
    assert str(caught.value).startswith(message)


def observation(**changes: tuple[int, float]) -> dict[str, Any]:
    parts = {"observation": np.zeros(5), "desired_goal": np.ones(2), "achieved_goal": np.ones(2)}
    for name, (index, value) in changes.items():
        parts[name][index] = value
    return parts


def begun(*, zero_goal: bool = False) -> Recording:
    name, success = "Env-v0, sub-environment 2", ("done", False)
    recording = Recording(LAYOUT, zero_goal=zero_goal, name=name, success=success)
    recording.see(observation())
    return recording


def take(recording: Recording, seen: Any, reward: Any = -1.0, **info: Any) -> None:
    recording.step(np.zeros(2, np.float32), reward, info, seen)


@pytest.mark.parametrize(
    ("seen", "reward", "named"),
    [
        (observation(observation=(4, np.nan)), 0.0, r"observation\[4\] is nan"),
        (observation(desired_goal=(1, np.inf)), 0.0, r"desired_goal\[1\] is inf"),
        (observation(achieved_goal=(0, -1e30)), 0.0, r"achieved_goal\[0\] is -1e\+30"),
        (observation(), np.nan, "reward is nan"),
        (observation(), -np.inf, "reward is -inf"),
        (observation(), 1e30, r"reward is 1e\+30"),
    ],
)
def test_a_step_that_returns_one_ends_the_episode_with_its_place(
    seen: Any, reward: float, named: str
) -> None:
    recording = begun()
    take(recording, observation())
    with pytest.raises(BadNumberError, match=f"^Env-v0, sub-environment 2, step 2: {named}, every"):
        take(recording, seen, reward)


NO_SUCCESS = ["False", "yes", 0.3, np.nan, 2, None, np.zeros(1), np.array([True]), [1], b"1", 1j]


@pytest.mark.parametrize("value", NO_SUCCESS, ids=repr)
def test_a_success_that_is_neither_true_nor_false_is_refused_with_key_and_value(value: Any) -> None:
    recording = begun()
    with pytest.raises(BadNumberError) as caught:
        take(recording, observation(), done=value)
    rule = "info['done'] must be a bool, or the number 0 or 1, got "
    assert str(caught.value).startswith(f"Env-v0, sub-environment 2, step 1: {rule}{value!r}")


@pytest.mark.parametrize("kind", [bool, int, float, np.bool_, np.float16, np.uint8, np.array])
def test_a_success_is_a_bool_or_0_or_1_and_a_step_without_it_has_none(kind: Any) -> None:
    recording = begun()
    for info in ({"done": kind(1)}, {"done": kind(0)}, {}):
        take(recording, observation(), **info)
    successes = recording.finish(terminated=False).successes
    assert successes is not None
    assert successes.tolist() == [True, False, False]


@pytest.mark.parametrize("reward", ["-1", None, np.array([-1.0]), [0.0], 1j], ids=repr)
def test_a_reward_that_is_no_number_is_refused(reward: Any) -> None:
    with pytest.raises(BadNumberError, match="step 1: reward must be a number, got"):
        take(begun(), observation(), reward)


@pytest.mark.parametrize(
    ("seen", "rule"),
    [
        (observation() | {"achieved_goal": np.float32(1.0)}, "achieved_goal must have shape (2,)"),
        (observation() | {"observation": np.zeros((1, 5))}, "observation must have shape (5,)"),
        (observation() | {"desired_goal": np.array(["1", "2"])}, "desired_goal must have shape"),
        (observation() | {"observation": np.zeros(5, complex)}, "and hold numbers, got"),
        ({"observation": np.zeros(5)}, "observation must be a dictionary with observation"),
        (np.zeros(9), "observation must be a dictionary with observation"),
    ],
)
def test_what_numpy_would_repeat_or_read_as_numbers_is_refused(seen: Any, rule: str) -> None:
    with pytest.raises(BadNumberError) as caught:
        begun(zero_goal=True).see(seen)
    assert rule in str(caught.value)


def test_large_numbers_that_float32_holds_well_pass_and_so_does_a_goal_nobody_sees() -> None:
    recording = begun(zero_goal=True)
    take(recording, observation(observation=(0, 9e14), desired_goal=(0, np.nan)), 9e14)
    take(recording, {**observation(), "observation": np.full(5, 9e14)})
    assert recording.finish(terminated=False).frames[1, 0] == np.float32(9e14)
    flat = ReplayLayout(observation=3, action=1, goal=0, horizon=2)
    recording = Recording(flat, zero_goal=False, name="Flat-v0")
    with pytest.raises(BadNumberError, match=r"^Flat-v0, step 0: observation\[1\] is nan"):
        recording.see(np.array([0.0, np.nan, 1.0]))
