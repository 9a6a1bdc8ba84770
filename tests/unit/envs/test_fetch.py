"""The faster Fetch step equals the step of Gymnasium-Robotics."""

import itertools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from music_rllib.envs.fetch import speed_up
from music_rllib.envs.goal_functions import goal_reward_of, moved_distance_of
from music_rllib.envs.make import make_env
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


@pytest.mark.parametrize(("reward_type", "steps"), [("sparse", 120), ("dense", 50)])
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


Change = Callable[[Any, int], None]
"""Changes an environment (unwrapped) before its reset of this number."""


def cheerful(env: Any, episode: int) -> None:
    """As a user's script may do."""
    env.compute_reward = lambda achieved, goal, info: 1.0


def rebuilt(env: Any, episode: int) -> None:
    """As a wrapper with domain randomization does: a new model and data."""
    initial = {"robot0:slide0": 0.4049, "robot0:slide1": 0.48, "robot0:slide2": 0.0}
    env.initial_qpos = initial | {"object0:joint": [1.25, 0.53, 0.4, 1.0, 0.0, 0.0, 0.0]}
    env._initialize_simulation()
    edited(env, episode)


def edited(env: Any, episode: int) -> None:
    """The model keeps its identity and changes its numbers, including the time step."""
    env.model.geom_size[env.model.geom("object0").id] = 0.02 + 0.005 * episode
    env.model.opt.timestep = 0.002 / (1 + episode)


def heavier_actions(env: Any, episode: int) -> None:
    env.action_space = gym.spaces.Box(-0.5, 0.5, (4,), np.float32)


def other_callback(env: Any, episode: int) -> None:
    env._step_callback = lambda: env.data.qvel.__imul__(0.5)


def other_observation(env: Any, episode: int) -> None:
    plain = type(env)._get_obs

    def noisy() -> Any:
        found = plain(env)
        return found | {"observation": found["observation"] + 1}

    env._get_obs = noisy


@pytest.mark.parametrize(
    ("fast", "kept"),
    [(rebuilt, cheerful), (edited, other_callback), (heavier_actions, other_observation)],
)
def test_changes_between_episodes_take_effect(fast: Change, kept: Change) -> None:
    """The faster step follows some changes; others restore the original step."""
    envs = [make_env("FetchPush-v4"), original("FetchPush-v4")]
    assert "step" in vars(envs[0].unwrapped)
    rng = np.random.default_rng(1)
    for episode, changes in enumerate([[fast], [fast], [kept], [fast, kept]]):
        for change, env in itertools.product(changes, envs):
            change(env.unwrapped, episode)
        pair = [env.reset(seed=episode)[0] for env in envs]
        assert all(same(pair[0][key], pair[1][key]) for key in pair[1])
        for _ in range(5):
            action = rng.uniform(-1, 1, 4)
            mine, theirs = (env.step(action) for env in envs)
            assert all(same(mine[0][key], theirs[0][key]) for key in theirs[0])
            assert mine[1] == theirs[1]
        assert ("step" in vars(envs[0].unwrapped)) == (changes == [fast])


@pytest.mark.parametrize("on_the_class", [True, False], ids=["their class", "a class of its own"])
def test_an_environment_with_its_own_reward_keeps_its_step(
    on_the_class: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_env("FetchReach-v4")  # registers the robotics tasks
    from gymnasium_robotics.envs.fetch.fetch_env import MujocoFetchEnv
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

    plain = MujocoFetchEnv.compute_reward

    class Cheerful(MujocoFetchReachEnv):  # type: ignore[misc]
        def compute_reward(self, achieved_goal: Any, goal: Any, info: Any) -> Any:
            return plain(self, achieved_goal, goal, info) + 1

    if on_the_class:
        monkeypatch.setattr(MujocoFetchEnv, "compute_reward", Cheerful.compute_reward)
    entry = MujocoFetchReachEnv if on_the_class else Cheerful
    gym.register(f"CheerfulReach{on_the_class}-v0", entry)
    env = make_env(f"CheerfulReach{on_the_class}-v0")
    assert "step" not in vars(env.unwrapped)
    env.reset(seed=0)
    assert env.step(np.zeros(4, np.float32))[1] in (0.0, 1.0)


def test_another_robot_keeps_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    env = original("FetchPush-v4")
    monkeypatch.setattr(env.unwrapped, "_model_names", SimpleNamespace(joint_names=["robot0:none"]))
    speed_up(env)
    assert "step" not in vars(env.unwrapped)


@pytest.mark.parametrize(("reward_type", "distance"), [("sparse", None), ("dense", 0.01)])
def test_a_sparse_reward_decides_what_moved_and_a_dense_one_uses_the_threshold(
    reward_type: str, distance: float | None
) -> None:
    env = make_env("FetchPush-v4", reward_type=reward_type)
    assert moved_distance_of(env, goal_reward_of(env)) == pytest.approx(distance)
