"""The faster Fetch step against Gymnasium-Robotics' own."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from music_rllib.envs.make import goal_reward_of, make_env, moved_distance_of
from music_rllib.envs.tasks import BUILT_IN_TASKS

FETCH = [task.env_id for task in BUILT_IN_TASKS.values() if task.env_id.startswith("Fetch")]


def original(env_id: str, **kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(env_id, disable_env_checker=True, **kwargs)


def simulator(env: gym.Env[Any, Any]) -> Any:
    return env.unwrapped.data  # type: ignore[attr-defined]


def same(left: Any, right: Any) -> bool:
    """Equal type, shape and bits."""
    left_array, right_array = np.asarray(left), np.asarray(right)
    return (
        type(left) is type(right)
        and left_array.dtype == right_array.dtype
        and left_array.shape == right_array.shape
        and left_array.tobytes() == right_array.tobytes()
    )


@pytest.mark.parametrize(("reward_type", "steps"), [("sparse", 300), ("dense", 50)])
@pytest.mark.parametrize("env_id", FETCH)
def test_fast_fetch_steps_equal_the_originals_bit_for_bit(
    env_id: str, reward_type: str, steps: int
) -> None:
    fast = make_env(env_id, reward_type=reward_type)
    assert "step" in vars(fast.unwrapped), "the faster step is not in use"
    slow = original(env_id, reward_type=reward_type)
    rng = np.random.default_rng(3)
    for step in range(steps):
        if step % 50 == 0:
            pair = [env.reset(seed=step)[0] for env in (fast, slow)]
            assert all(same(pair[0][key], pair[1][key]) for key in pair[1])
        # Also beyond the bounds, where the original clips, and in both precisions.
        action = rng.uniform(-1.2, 1.2, 4).astype(np.float32 if step % 2 else np.float64)
        mine, theirs = fast.step(action), slow.step(action)
        assert mine[0].keys() == theirs[0].keys()
        assert all(same(mine[0][key], theirs[0][key]) for key in theirs[0])
        assert same(mine[1], theirs[1])
        assert mine[2:4] == theirs[2:4]
        assert mine[4].keys() == theirs[4].keys()
        assert same(mine[4]["is_success"], theirs[4]["is_success"])
    left, right = simulator(fast), simulator(slow)
    assert same(left.qpos, right.qpos)
    assert same(left.qacc_warmstart, right.qacc_warmstart), "the solver's start at the next step"


def test_an_environment_with_a_reward_of_its_own_keeps_its_step() -> None:
    make_env("FetchReach-v4")  # registers the robotics tasks
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

    class Cheerful(MujocoFetchReachEnv):  # type: ignore[misc]
        def compute_reward(self, achieved_goal: Any, goal: Any, info: Any) -> Any:
            return super().compute_reward(achieved_goal, goal, info) + 1

    gym.register("CheerfulReach-v0", Cheerful)
    env = make_env("CheerfulReach-v0")
    assert "step" not in vars(env.unwrapped)
    env.reset(seed=0)
    assert env.step(np.zeros(4, np.float32))[1] in (0.0, 1.0)


def test_an_action_of_another_size_is_refused() -> None:
    env = make_env("FetchReach-v4")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="Action dimension mismatch"):
        env.step(np.zeros(3, np.float32))


@pytest.mark.parametrize(("reward_type", "distance"), [("sparse", None), ("dense", 0.01)])
def test_moved_is_what_a_sparse_reward_says_and_a_fifth_of_the_threshold_of_a_dense_one(
    reward_type: str, distance: float | None
) -> None:
    env = make_env("FetchPush-v4", reward_type=reward_type)
    assert moved_distance_of(env, goal_reward_of(env)) == pytest.approx(distance)
