"""Symmetries: their effect on transitions, and whether real environments have them."""

from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium_robotics.utils import mujoco_utils
from pydantic import ValidationError

from music_rllib.envs.features import Augmentation, Mirror, Symmetries, Symmetry, Translation
from music_rllib.envs.goal_functions import augmentation_of, compute_reward_of
from music_rllib.envs.make import Env, make_env
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.replay.trajectories import Floats, ReplayLayout, Transitions
from music_rllib.tac.algorithm import TAC, TACConfig

LAYOUT = ReplayLayout(observation=4, action=2, goal=1, horizon=9)
MIRROR = Mirror(positions=(0,), goal=(0,), plane=0.5, signs=(1,), action=(1,), swap=((2, 3),))


def transitions(count: int, layout: ReplayLayout = LAYOUT) -> Transitions:
    rng = np.random.default_rng(1)
    inputs, following = rng.normal(size=(2, count, layout.network_input)).astype(np.float32)
    actions = rng.normal(size=(count, layout.action)).astype(np.float32)
    ones = np.ones(count, np.float32)
    return Transitions(inputs, actions, ones, ones, following, None, np.arange(count))


def changed(symmetries: Symmetries, *, goals: bool = True) -> tuple[Transitions, Transitions]:
    given, after = transitions(1_000), transitions(1_000)
    Augmentation(symmetries, symmetries.kinds, LAYOUT, goals=goals)(np.random.default_rng(0), after)
    return given, after


def test_half_of_the_transitions_are_mirrored() -> None:
    given, after = changed(Symmetries(mirror=MIRROR))
    rows = (given.actions != after.actions).any(1)
    assert 450 < rows.sum() < 550
    for before, now in ((given.inputs, after.inputs), (given.next_inputs, after.next_inputs)):
        np.testing.assert_array_equal(now[~rows], before[~rows])
        x, speed, left, right, goal = before[rows].T
        np.testing.assert_allclose(now[rows].T, [1 - x, -speed, right, left, 1 - goal], atol=1e-6)
    np.testing.assert_array_equal(after.actions[rows], given.actions[rows] * [1, -1])
    np.testing.assert_array_equal(after.rewards, given.rewards)


def test_positions_and_goals_are_moved_together() -> None:
    moves = (Translation(positions=(0, 2), goal=(0,), distance=0.1),)
    given, after = changed(Symmetries(translate=moves))
    by = after.inputs - given.inputs
    np.testing.assert_allclose(after.next_inputs - given.next_inputs, by, atol=1e-6)
    np.testing.assert_allclose(by[:, [0, 2, 4]], by[:, [0]] * np.ones(3), atol=1e-6)
    assert not by[:, [1, 3]].any()
    assert -0.1 <= by.min() < -0.095
    assert 0.095 < by.max() <= 0.1 + 1e-6
    np.testing.assert_array_equal(after.actions, given.actions)


def test_goals_of_zeros_keep_their_zeros() -> None:
    moves = (Translation(positions=(0,), goal=(0,), distance=0.1),)
    given, after = changed(Symmetries(mirror=MIRROR, translate=moves), goals=False)
    np.testing.assert_array_equal(given.inputs[:, 4], after.inputs[:, 4])
    assert (given.inputs[:, 0] != after.inputs[:, 0]).all()


@pytest.mark.parametrize(
    ("mirror", "message"),
    [
        ({"positions": [1], "signs": [1]}, "each entry once, 1 is there twice"),
        ({"swap": [[1, 2], [2, 3]]}, "each entry once, 2 is there twice"),
        ({"action": [0, 0]}, "action must have each entry once"),
        ({"plane": float("nan")}, "finite"),
    ],
)
def test_what_is_no_reflection_is_refused(mirror: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Symmetries.model_validate({"mirror": mirror})


@pytest.mark.parametrize(
    ("symmetries", "message"),
    [
        ({"mirror": {"signs": [4]}}, "mirror.signs must be < 4, got 4"),
        ({"mirror": {"action": [2]}}, "mirror.action must be < 2, got 2"),
        ({"mirror": {"swap": [[0, 9]]}}, "mirror.swap must be < 4, got 9"),
        ({"translate": [{"goal": [1], "distance": 1}]}, r"translate\[0\].goal must be < 1, got 1"),
    ],
)
def test_entries_beyond_a_vector_are_refused(symmetries: dict[str, Any], message: str) -> None:
    declared = Symmetries.model_validate(symmetries)
    with pytest.raises(ValueError, match=message):
        Augmentation(declared, declared.kinds, LAYOUT)


def test_a_symmetry_that_is_not_declared_is_refused() -> None:
    used: tuple[Symmetry, ...] = ("mirror", "translate")
    with pytest.raises(ValueError, match="must have the symmetry translate to use it"):
        Augmentation(Symmetries(mirror=MIRROR), used, LAYOUT)


def layout_of(env: Env) -> ReplayLayout:
    spaces: Any = env.observation_space
    return ReplayLayout(spaces["observation"].shape[0], 4, spaces["achieved_goal"].shape[0], 50)


class GoalsWithoutReward(gym.Env[dict[str, Floats], Floats]):
    """Has goals, and a reward that only a step computes."""

    observation_space = gym.spaces.Dict(
        {
            name: gym.spaces.Box(-9, 9, (size,), np.float32)
            for name, size in (("observation", 4), ("achieved_goal", 1), ("desired_goal", 1))
        }
    )
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)


def test_symmetries_that_change_rewards_are_refused() -> None:
    env = make_env("FetchPush-v4")
    shift = (Translation(positions=(0, 3), goal=(0,), distance=0.1),)
    reward, layout = compute_reward_of(env), layout_of(env)
    declared = Symmetries(translate=shift)
    augmentation_of(declared, declared.kinds, layout, env, reward=reward)

    def absolute(achieved: Floats, desired: Floats) -> Floats:
        return achieved[:, 0] - desired[:, 1]

    with pytest.raises(ValueError, match="must keep rewards: with FetchPush-v4, compute_reward di"):
        augmentation_of(declared, declared.kinds, layout, env, reward=absolute)
    # Also without hindsight, which needs no other rewards.
    wrong = Symmetries(mirror=Mirror(positions=(1,), goal=(1,), plane=0.0))
    env.unwrapped.compute_reward = lambda achieved, desired, info: absolute(desired, achieved)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="must keep rewards: with FetchPush-v4, compute_reward di"):
        augmentation_of(wrong, wrong.kinds, layout, env)


@pytest.mark.parametrize("goals", ["environment", "zero"])
def test_goals_change_also_without_a_compute_reward(goals: str) -> None:
    """A replay without hindsight does not need rewards of other goals."""

    class Runner:
        layout = LAYOUT
        env = GoalsWithoutReward()

    config = TACConfig().music(goals=goals)
    config.replay(hindsight_k=0, symmetries=("mirror",), task_symmetries={"mirror": MIRROR})
    algorithm = cast(
        "Any",
        SimpleNamespace(
            config=config, _settings=config.settings, _runner_with_environment=lambda: Runner
        ),
    )
    augment = TAC._make_replay(algorithm)._augment
    assert augment is not None
    given, after = transitions(1_000), transitions(1_000)
    augment(np.random.default_rng(0), after)
    rows = (given.actions != after.actions).any(1)
    expected = 1 - given.inputs[rows, 4] if goals == "environment" else given.inputs[rows, 4]
    np.testing.assert_allclose(after.inputs[rows, 4], expected, atol=1e-6)


def push(env: Any, mirrored: bool, shift: tuple[float, float], side: float, steps: int) -> Floats:
    """[T, I] network inputs while the gripper, at `shift`, pushes an object in front of it."""
    env.reset(seed=0)
    robot, sign = env.unwrapped, -1.0 if mirrored else 1.0
    at = mujoco_utils.get_site_xpos(robot.model, robot.data, "robot0:grip")
    at[:2] += shift
    mujoco_utils.set_mocap_pos(robot.model, robot.data, "robot0:mocap", at)
    mujoco.mj_step(robot.model, robot.data, nstep=400)
    block = mujoco_utils.get_joint_qpos(robot.model, robot.data, "object0:joint")
    block[:2] = 1.4219 + shift[0], 0.75 + shift[1] + sign * side
    mujoco_utils.set_joint_qpos(robot.model, robot.data, "object0:joint", block)
    mujoco_utils.set_joint_qvel(robot.model, robot.data, "object0:joint", np.zeros(6))
    mujoco.mj_forward(robot.model, robot.data)
    robot.goal = np.array([1.5 + shift[0], 0.75 + shift[1] + sign * 0.1, 0.42])
    action = np.array([0.25, sign * 0.2, 0.0, 0.0])
    seen = [robot._get_obs(), *(env.step(action)[0] for _ in range(steps))]
    return np.array(
        [np.concatenate([one["observation"], one["desired_goal"]]) for one in seen], np.float32
    )


@pytest.mark.parametrize("kind", ["mirror", "translate"])
def test_fetch_has_its_symmetries(kind: Any) -> None:
    """Pushes from mirrored and moved positions are mirrored and moved ones.

    The arm, which is not symmetric, brings the gripper about 2 mm away from the exact position, and
    contacts enlarge this difference. A wrong sign or entry would be one of centimeters.
    """
    env = make_env("FetchPush-v4")
    symmetries, layout = BUILT_IN_TASKS["FetchPush"].symmetries, layout_of(env)
    augmentation = Augmentation(symmetries, (kind,), layout)
    shift = (0.0, 0.0) if kind == "mirror" else (0.03, 0.04)
    errors, distances = [], []
    for side in (0.004, 0.008, 0.012):
        plain = push(env, False, (0.0, 0.0), side, 10)
        other = push(env, kind == "mirror", shift, side, 10)
        for place, by in zip(augmentation._moves, shift, strict=False):
            plain[:, place[0]] += by
        if kind == "mirror":
            plain = plain[:, augmentation._order] * augmentation._sign + augmentation._offset
        errors.append(np.abs(other - plain).max(0))
        distances.append(np.abs(plain[-1] - plain[0]).max())
    assert min(distances) > 0.05
    places = [*range(9), *range(25, 28)]
    assert np.median(errors, 0)[places].max() < 0.015
