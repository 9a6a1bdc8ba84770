"""Hindsight uses rewards only where the goals of a step decide them."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.envs.episodes import first_mismatch, lost_by_rounding
from music_rllib.envs.make import goal_reward_of

Floats = NDArray[Any]


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
def test_rewards_of_rounded_goals_pass_at_any_scale_and_others_do_not(
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


def test_a_step_at_the_threshold_is_not_refused_for_its_rounding() -> None:
    """The environment prices goals in float64, which the replay keeps in float32."""
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


def test_a_cost_that_the_lowest_action_does_not_show_is_found() -> None:
    goal_reward_of(Reach(0.0))
    with pytest.raises(ValueError, match="must be 0 where compute_reward is not the whole reward"):
        goal_reward_of(Reach(0.5))
