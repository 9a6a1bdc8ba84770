"""Recorded episodes: values that are refused, and rewards that hindsight can use."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.envs.episodes import Recording, first_mismatch, lost_by_rounding
from music_rllib.envs.goal_functions import goal_end_of, goal_reward_of, moved_distance_of
from music_rllib.envs.make import in_environment, make_env
from music_rllib.envs.values import BadNumberError
from music_rllib.replay.trajectories import ReplayLayout

Floats = NDArray[Any]
LAYOUT = ReplayLayout(observation=5, action=2, goal=2, horizon=4)


def observation(**changes: tuple[int, float]) -> dict[str, Any]:
    parts = {"observation": np.zeros(5), "desired_goal": np.ones(2), "achieved_goal": np.ones(2)}
    for name, (index, value) in changes.items():
        parts[name][index] = value
    return parts


def started(*, zero_goal: bool = False) -> Recording:
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
def test_a_bad_number_is_named_with_its_step(seen: Any, reward: float, named: str) -> None:
    recording = started()
    take(recording, observation())
    with pytest.raises(BadNumberError, match=f"^Env-v0, sub-environment 2, step 2: {named}, every"):
        take(recording, seen, reward)


NO_SUCCESS = ["False", "yes", 0.3, np.nan, 2, None, np.zeros(1), np.array([True]), [1], b"1", 1j]


@pytest.mark.parametrize("value", NO_SUCCESS, ids=repr)
def test_a_success_that_is_neither_true_nor_false_is_refused_with_its_key(value: Any) -> None:
    recording = started()
    with pytest.raises(BadNumberError) as caught:
        take(recording, observation(), done=value)
    rule = "info['done'] must be a bool, or the number 0 or 1, got "
    assert str(caught.value).startswith(f"Env-v0, sub-environment 2, step 1: {rule}{value!r}")


@pytest.mark.parametrize("kind", [bool, int, float, np.bool_, np.float16, np.uint8, np.array])
def test_a_success_is_a_bool_or_0_or_1_and_a_missing_one_is_false(kind: Any) -> None:
    recording = started()
    for info in ({"done": kind(1)}, {"done": kind(0)}, {}):
        take(recording, observation(), **info)
    successes = recording.finish(terminated=False).successes
    assert successes is not None
    assert successes.tolist() == [True, False, False]


@pytest.mark.parametrize("reward", ["-1", None, np.array([-1.0]), [0.0], 1j], ids=repr)
def test_a_reward_that_is_not_a_number_is_refused(reward: Any) -> None:
    with pytest.raises(BadNumberError, match="step 1: reward must be a number, got"):
        take(started(), observation(), reward)


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
def test_values_that_numpy_would_repeat_or_convert_are_refused(seen: Any, rule: str) -> None:
    with pytest.raises(BadNumberError) as caught:
        started(zero_goal=True).see(seen)
    assert rule in str(caught.value)


def test_large_numbers_pass_and_a_replaced_goal_is_not_checked() -> None:
    recording = started(zero_goal=True)
    take(recording, observation(observation=(0, 9e14), desired_goal=(0, np.nan)), 9e14)
    assert recording.finish(terminated=False).frames[1, 0] == np.float32(9e14)
    flat = ReplayLayout(observation=3, action=1, goal=0, horizon=2)
    recording = Recording(flat, zero_goal=False, name="Flat-v0")
    with pytest.raises(BadNumberError, match=r"^Flat-v0, step 0: observation\[1\] is nan"):
        recording.see(np.array([0.0, np.nan, 1.0]))


# -- rewards of goals -------------------------------------------------------------------------


def sparse(achieved: Floats, desired: Floats) -> Floats:
    return -np.asarray(np.linalg.norm(achieved - desired, axis=-1) > 0.05, np.float64)


def dense(achieved: Floats, desired: Floats) -> Floats:
    return -np.asarray(np.linalg.norm(achieved - desired, axis=-1))


def episode(seed: int = 0, spread: float = 0.05) -> Floats:
    """[51, 6] desired and achieved goals, in float64."""
    rng = np.random.default_rng(seed)
    achieved = 1.3 + spread * rng.standard_normal((51, 3))
    return np.concatenate([np.full((51, 3), 1.3), achieved], axis=1)


@pytest.mark.parametrize("reward", [sparse, dense])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_rewards_of_rounded_goals_pass_at_any_scale_and_other_rewards_do_not(
    reward: Any, scale: float
) -> None:
    goals = episode()
    kept = goals.astype(np.float32)

    def scaled(achieved: Floats, desired: Floats) -> Floats:
        return scale * np.asarray(reward(achieved, desired))

    given = scaled(goals[1:, 3:], goals[1:, :3]).astype(np.float32)
    assert first_mismatch(scaled, kept, given) is None
    # A cost of a thousandth of the reward's range, in one step only.
    cost = 1e-3 * np.float32(np.ptp(given)) * (np.arange(50) == 30)
    found = first_mismatch(scaled, kept, given - cost)
    assert found is not None
    assert found[0] == 31
    other_scale = first_mismatch(scaled, kept, np.float32(0.5) * given)
    assert other_scale is not None


def test_rounding_at_a_threshold_is_not_a_mismatch() -> None:
    """The environment computes rewards from float64 goals; the replay keeps them in float32."""
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((20_001, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    desired = 1.3 + rng.random((20_001, 3))
    achieved = desired + (0.05 + 1e-8 * rng.standard_normal((20_001, 1))) * directions
    goals, given = np.concatenate([desired, achieved], axis=1), sparse(achieved, desired)[1:]
    kept = goals.astype(np.float32)
    rounded = sparse(kept[1:, 3:].astype(float), kept[1:, :3].astype(float))
    assert (rounded != given).mean() > 0.2
    assert first_mismatch(sparse, kept[:200], given[:199].astype(np.float32)) is None


def test_a_reward_may_belong_to_the_goal_before_its_step() -> None:
    goals = episode()
    goals[:, :3] += np.arange(51)[:, None]
    given = dense(goals[1:, 3:], goals[:-1, :3]).astype(np.float32)
    assert first_mismatch(dense, goals.astype(np.float32), given) is None


@pytest.mark.parametrize(
    ("origin", "distance", "reward", "kept"),
    [
        (1.3, 0.15, sparse, True),
        (1.3, 0.01, dense, True),
        (4.6e6, 1.0, sparse, False),
        (4.6e6, 100.0, dense, False),
        (4.6e6, 1e5, dense, True),
        (4.6e6, 3e3, lambda a, d: sparse(a / 4e3, d / 4e3), True),
    ],
)
def test_goals_whose_rewards_float32_would_change_are_refused(
    origin: float, distance: float, reward: Any, kept: bool
) -> None:
    lost = lost_by_rounding(reward, np.array([5e5 if origin > 2 else 1.0, origin]), distance)
    assert (lost is None) == kept
    assert kept or (lost is not None and lost.startswith("achieved_goal[1] is 4600000, which"))


class Reach(gym.Env[Any, Any]):
    """A point that moves by its action; a step costs `cost` times the squared action."""

    action_space = spaces.Box(0.0, 1.0, (2,), np.float32)
    observation_space = spaces.Dict(
        {name: spaces.Box(-9, 9, (2,)) for name in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self, cost: float) -> None:
        self.cost = cost

    def compute_reward(self, achieved: Floats, desired: Floats, info: Any) -> Floats:
        return sparse(achieved, desired)

    def reset(self, **arguments: Any) -> Any:
        super().reset(**arguments)
        self.at = self.np_random.uniform(-1, 1, 2)
        return self.seen(), {}

    def seen(self) -> dict[str, Floats]:
        return {"observation": self.at, "achieved_goal": self.at, "desired_goal": np.zeros(2)}

    def step(self, action: Any) -> Any:
        self.at = self.at + 0.1 * action
        reward = float(sparse(self.at, np.zeros(2)) - self.cost * np.square(action).sum())
        return self.seen(), reward, False, False, {}


def test_an_additional_cost_of_actions_is_found() -> None:
    goal_reward_of(Reach(0.0))
    with pytest.raises(ValueError, match="must be 0 if compute_reward is not the whole reward"):
        goal_reward_of(Reach(0.5))


def test_a_reward_that_changes_its_arguments_does_not_change_the_replay() -> None:
    class InPlace(Reach):
        def compute_reward(self, achieved: Floats, desired: Floats, info: Any) -> Floats:
            desired -= achieved
            return sparse(desired, np.zeros_like(desired))

    reward = goal_reward_of(InPlace(0.0))
    kept = np.ones((3, 2), np.float32)
    np.testing.assert_array_equal(reward(kept, kept), reward(kept[:1], kept))
    np.testing.assert_array_equal(kept, 1)


class Ends(Reach):
    """Ends an episode within 0.05 of the goal, as computed for batches or for single goals."""

    def __init__(self, end: Any) -> None:
        super().__init__(0.0)
        self.end = end

    def compute_terminated(self, achieved: Floats, desired: Floats, info: Any) -> Any:
        return self.end(achieved, desired)


def near(achieved: Floats, desired: Floats) -> Any:
    return np.linalg.norm(achieved - desired, axis=-1) < 0.05


def near_alone(achieved: Floats, desired: Floats) -> bool:
    return bool(np.linalg.norm(achieved - desired) < 0.05)  # of a batch: one bool


def mixes_rows(achieved: Floats, desired: Floats) -> Any:
    """Of a batch, the first row's achieved goal for all."""
    return near(achieved[0] if achieved.ndim > 1 else achieved, desired)


def near_one(achieved: Floats, desired: Floats) -> bool:
    return bool(np.hypot(*(achieved - desired)) < 0.05)  # raises for a batch


@pytest.mark.parametrize("end", [near, near_alone, near_one, mixes_rows])
def test_the_end_at_a_goal_is_computed_for_each_row(end: Any) -> None:
    ends = goal_end_of(Ends(end))
    assert ends is not None
    achieved = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0]], np.float32)
    desired = np.array([[0.0, 0.04], [0.0, 1.0], [3.01, 0.0]], np.float32)
    assert ends(achieved, desired).tolist() == [True, False, True]


def test_only_environments_that_are_known_to_never_end_have_no_function_for_it() -> None:
    assert goal_end_of(Reach(0.0)) is None
    assert goal_end_of(make_env("FetchPush-v4")) is None

    def lifted(achieved: Floats, desired: Floats) -> Any:
        return near(achieved, desired) & (achieved[..., 1] > 5)

    ends = goal_end_of(Ends(lifted))
    assert ends is not None
    high = np.full((2, 2), 9.0, np.float32)
    assert ends(high, high).tolist() == [True, True]


def test_calls_of_the_checks_are_watched_like_those_of_training() -> None:
    """An environment that hangs only on a worker's machine would hang there first."""
    watched: list[bool] = []

    class Watched(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **options: Any) -> Any:
            watched.append(in_environment._number[0] % 2 == 1)
            return super().reset(**options)

        def step(self, action: Any) -> Any:
            watched.append(in_environment._number[0] % 2 == 1)
            return super().step(action)

    env = Watched(make_env("FetchPush-v4"))
    moved_distance_of(env, goal_reward_of(env))
    assert len(watched) > 1
    assert all(watched)


def test_the_reward_of_a_wrapper_counts() -> None:
    class Tight(gym.Wrapper[Any, Any, Any, Any]):
        def compute_reward(self, achieved: Floats, desired: Floats, info: Any) -> Any:
            return -(np.linalg.norm(achieved - desired, axis=-1) > 0.01).astype(np.float32)

        def step(self, action: Any) -> Any:
            seen, _, *ends, info = self.env.step(action)
            goals = seen["achieved_goal"], seen["desired_goal"]
            return seen, float(self.compute_reward(*goals, {})), *ends, info

    reward = goal_reward_of(Tight(make_env("FetchPush-v4")))
    near = np.array([[0.03, 0.0, 0.0]], np.float32)
    assert reward(0.0 * near, near).tolist() == [-1.0]


def test_the_end_of_a_wrapper_counts() -> None:
    class EndsAtGoal(gym.Wrapper[Any, Any, Any, Any]):
        def compute_terminated(self, achieved: Floats, desired: Floats, info: Any) -> Any:
            return near(achieved, desired)

    ends = goal_end_of(EndsAtGoal(make_env("FetchPush-v4")))
    assert ends is not None
    assert ends(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32)).all()


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (
            lambda achieved, desired: dict[str, Any]()["is_success"],
            "it raises KeyError: 'is_success'",
        ),
        (lambda *goals: 0.5, "must be a bool, or the number 0 or 1, got 0.5"),
    ],
)
def test_an_end_that_depends_on_more_than_goals_is_refused(end: Any, reason: str) -> None:
    with pytest.raises(ValueError, match="hindsight_k must be 0 if compute_terminated") as error:
        goal_end_of(Ends(end))
    assert reason in str(error.value)


@pytest.mark.parametrize(
    ("places", "terminated", "found"),
    [
        ([0.3, 0.2, 0.01], True, None),
        ([0.3, 0.2, 0.3], True, None),  # another reason
        ([0.3, 0.2, 0.3], False, None),
        ([0.3, 0.05 - 1e-9, 0.3], False, None),  # rounding
        ([0.3, 0.2, 0.01], False, "step 3"),
        ([0.3, 0.01, 0.3], False, "step 2"),
        ([0.3, 0.01, 0.3], True, "step 2"),
    ],
)
def test_episodes_end_where_compute_terminated_is_true(
    places: list[float], terminated: bool, found: str | None
) -> None:
    goal = {"desired_goal": np.zeros(2)}
    recording = Recording(ReplayLayout(2, 2, 2, 5), name="Ends", goal_reward=sparse, goal_end=near)
    for number, place in enumerate([1.0, *places]):
        at = np.array([place, 0.0])
        seen = {"observation": at, "achieved_goal": at, **goal}
        if number:
            recording.step(np.zeros(2, np.float32), sparse(at, goal["desired_goal"]), {}, seen)
        else:
            recording.see(seen)
    if found is None:
        assert recording.finish(terminated=terminated).terminated == terminated
        return
    with pytest.raises(BadNumberError, match=f"{found}: .*if episodes continue where"):
        recording.finish(terminated=terminated)


def test_a_step_without_success_is_none_if_another_step_reports_one() -> None:
    recording = Recording(LAYOUT, name="Env-v0", success=("done", None))
    recording.see(observation())
    for info in ({}, {"done": True}, {}):
        take(recording, observation(), **info)
    successes = recording.finish(terminated=False).successes
    assert successes is not None
    assert successes.tolist() == [False, True, False]
