"""PointCarry: the point picks up the object by touching it, and only then moves it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from music_rllib.envs.goal_functions import goal_reward_of, moved_distance_of
from music_rllib.envs.make import make_env
from music_rllib.envs.point_carry import PointCarry
from music_rllib.envs.tasks import BUILT_IN_TASKS

TASK = BUILT_IN_TASKS["PointCarry"]


def test_gymnasium_finds_no_fault() -> None:
    check_env(make_env(TASK.env_id, render_mode="rgb_array").unwrapped)


def test_the_object_moves_only_when_carried_and_success_is_the_reward() -> None:
    env = make_env(TASK.env_id)
    for seed in range(20):
        start, _ = env.reset(seed=seed)
        away = -start["achieved_goal"] / np.linalg.norm(start["achieved_goal"])
        for _ in range(5):
            observation, reward, *_, info = env.step(away.astype(np.float32))
            assert reward == -1.0
            assert not info["is_success"]
        assert np.array_equal(observation["achieved_goal"], start["achieved_goal"])
        for target in ("achieved_goal", "desired_goal"):
            for _ in range(20):
                way = observation[target] - observation["observation"][list(TASK.agent_indices)]
                action = np.clip(way / 0.1, -1, 1).astype(np.float32)
                observation, reward, *_, info = env.step(action)
        assert reward == 0.0
        assert info["is_success"]
        split = [
            observation["observation"][list(part)]
            for part in (TASK.agent_indices, TASK.surrounding_indices)
        ]
        assert np.array_equal(*split)
        assert np.array_equal(split[1], observation["achieved_goal"])


@pytest.mark.parametrize("width", [0.05, 1.0])
def test_a_reward_that_is_flat_near_the_goal_is_dense(width: float) -> None:
    class Smooth(PointCarry):
        def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
            distance = np.linalg.norm(np.asarray(achieved_goal) - desired_goal, axis=-1)
            return np.exp(-((distance / width) ** 2)) - 1

    sparse, smooth = PointCarry(), Smooth()
    assert moved_distance_of(sparse, goal_reward_of(sparse)) is None
    with pytest.raises(ValueError, match="has dense rewards and no distance_threshold"):
        moved_distance_of(smooth, goal_reward_of(smooth))
