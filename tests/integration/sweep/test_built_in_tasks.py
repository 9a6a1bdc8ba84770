"""Every built-in task compared with its environment, and training without Fetch's robot.

These are the checks that docs/add_an_environment.md describes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from music_rllib import names
from music_rllib.config.load import load_config
from music_rllib.config.run_settings import Evaluation, RunSettings, Variant, variant_music
from music_rllib.envs.goal_functions import goal_reward_of
from music_rllib.envs.make import make_env
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.experiment.plan import make_plan
from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.trajectories import ReplayLayout, Trajectory
from music_rllib.sweep.preflight import check_environments

Floats = NDArray[np.float64]
Env = gym.Env[Any, Any]
SPLIT = [name for name, task in BUILT_IN_TASKS.items() if task.has_split and name != "PointCarry"]
"""Tasks of simulators with an object."""


@pytest.fixture(scope="module", params=list(BUILT_IN_TASKS))
def task(request: pytest.FixtureRequest) -> Task:
    return BUILT_IN_TASKS[request.param]


@pytest.fixture(scope="module")
def env(task: Task) -> Iterator[Env]:
    made = make_env(task.env_id, **task.env_kwargs)
    yield made
    made.close()


# --- the split ---------------------------------------------------------------------------------


class Anatomy(NamedTuple):
    """Names of the joints that move the two parts of a split."""

    object_joint: str
    robot_joint: str
    """A joint that moves the agent's state and is not driven by other joints."""


ANATOMY = {
    "Fetch": Anatomy("object0:joint", "robot0:shoulder_pan_joint"),
    "HandManipulate": Anatomy("object:joint", "robot0:FFJ3"),
}


def anatomy(task: Task) -> Anatomy:
    (found,) = [parts for family, parts in ANATOMY.items() if task.name.startswith(family)]
    return found


def agent_state(task: Task, robot: Any) -> Floats:
    """The agent's state, read by name: Fetch's gripper, the hand's 24 joint angles."""
    if task.name.startswith("Fetch"):
        position: Floats = robot._utils.get_site_xpos(robot.model, robot.data, "robot0:grip")
        return position.copy()
    joints = [name for name in robot._model_names.joint_names if name.startswith("robot0:")]
    return np.concatenate(
        [robot._utils.get_joint_qpos(robot.model, robot.data, name) for name in joints]
    )


def moved(robot: Any, joint: str, by: float) -> Floats:
    """The observation after moving `joint`'s first coordinates without advancing time."""
    position = robot._utils.get_joint_qpos(robot.model, robot.data, joint)
    position[:3] += by
    robot._utils.set_joint_qpos(robot.model, robot.data, joint, position)
    robot._mujoco.mj_forward(robot.model, robot.data)
    observation: Floats = robot._get_obs()["observation"]
    return observation


def test_only_a_task_without_an_object_has_no_split(task: Task, env: Env) -> None:
    assert task.has_split == getattr(env.unwrapped, "has_object", True)


@pytest.mark.parametrize("task", SPLIT, indirect=True)
def test_split_entries_are_the_agent_and_the_object(task: Task, env: Env) -> None:
    agent, surrounding = list(task.agent_indices), list(task.surrounding_indices)
    robot: Any = env.unwrapped
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        observed = env.step(env.action_space.sample())[0]
        state = observed["observation"]
        np.testing.assert_array_equal(state[agent], agent_state(task, robot))
        # All goals begin with the object's position, in meters.
        np.testing.assert_array_equal(state[surrounding], observed["achieved_goal"][:3])
    before = moved(robot, anatomy(task).object_joint, 0.0)
    after = moved(robot, anatomy(task).object_joint, 0.05)
    np.testing.assert_allclose(after[surrounding], before[surrounding] + 0.05, atol=1e-12)
    np.testing.assert_array_equal(after[agent], before[agent])
    last = moved(robot, anatomy(task).robot_joint, 0.1)
    assert np.abs(last[agent] - after[agent]).max() > 0.05
    np.testing.assert_array_equal(last[surrounding], after[surrounding])


# --- episodes ----------------------------------------------------------------------------------


def play(env: Env, seed: int, goal: Floats | None = None) -> tuple[Trajectory, list[float]]:
    """An episode towards the object with noise; returns the success of its steps.

    Args:
        goal: replaces the goal of the environment.
    """
    rng = np.random.default_rng(seed)
    seen = [env.reset(seed=seed)[0]]
    if goal is not None:
        env.unwrapped.goal = goal.astype(np.float64)  # type: ignore[attr-defined]
    actions, rewards, successes = [], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        if len(action) == 4:  # Fetch: random actions would rarely touch the object
            towards = seen[-1]["achieved_goal"] - seen[-1]["observation"][:3]
            action[:3] = np.clip(10 * towards + 0.3 * action[:3], -1, 1)
        observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        seen.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        successes.append(float(info["is_success"]))
    assert not terminated
    keys = ("observation", "desired_goal", "achieved_goal")
    frames = np.array([np.concatenate([o[key] for key in keys]) for o in seen], np.float32)
    trajectory = Trajectory(
        frames, np.array(actions, np.float32), np.array(rewards, np.float32), False
    )
    return trajectory, successes


def layout_of(env: Env, task: Task) -> ReplayLayout:
    space: Any = env.observation_space
    (observation,), (goal,) = space["observation"].shape, space["desired_goal"].shape
    (action,) = env.action_space.shape or ()
    return ReplayLayout(observation, action, goal, task.horizon)


def test_episodes_last_the_horizon_and_report_success(task: Task, env: Env) -> None:
    trajectory, successes = play(env, seed=3)
    assert len(trajectory) == task.horizon
    assert task.success_key == "is_success"
    # Sparse rewards (0 if the goal is reached, otherwise -1) agree with the key.
    np.testing.assert_array_equal(trajectory.rewards, np.array(successes) - 1.0)
    assert task.reward_range == (-1.0, 0.0)


def test_a_seed_determines_the_episode(task: Task, env: Env) -> None:
    first, _ = play(env, seed=5)
    play(env, seed=6)
    again, _ = play(env, seed=5)
    np.testing.assert_array_equal(first.frames, again.frames)


# --- hindsight ---------------------------------------------------------------------------------


def test_recomputed_rewards_equal_the_rewards_of_the_environment(task: Task, env: Env) -> None:
    layout, reward = layout_of(env, task), goal_reward_of(env)
    for seed in range(3):
        episode, _ = play(env, seed)
        achieved = episode.frames[1:, layout.network_input :]
        desired = episode.frames[1:, layout.observation : layout.network_input]
        np.testing.assert_array_equal(reward(achieved, desired), episode.rewards)


def test_relabeled_rewards_equal_those_of_an_episode_with_that_goal(task: Task, env: Env) -> None:
    layout = layout_of(env, task)
    episode, _ = play(env, seed=0)
    replay = TrajectoryReplay(
        layout,
        task.horizon,
        np.random.default_rng(0),
        goal_reward=goal_reward_of(env),
        hindsight_k=1e9,
    )
    replay.extend([episode])
    drawn = replay.sample_transitions(2000)
    goals, states = drawn.inputs[:, layout.observation :], episode.frames[1:, : layout.observation]
    compared: set[float] = set()
    for later in (1, task.horizon // 2, task.horizon):
        goal = episode.frames[later, layout.network_input :]
        rows = np.flatnonzero((goals == goal).all(1))
        # Play the same episode again, with this goal in the environment from the start.
        repeated, _ = play(env, seed=0, goal=goal.astype(np.float64))
        np.testing.assert_array_equal(repeated.frames[:, :3], episode.frames[:, :3])
        for row in rows:
            state = drawn.next_inputs[row, : layout.observation]
            (step,) = np.flatnonzero((states == state).all(1))
            assert drawn.rewards[row] == repeated.rewards[step]
            compared.add(float(drawn.rewards[row]))
    assert compared == {-1.0, 0.0}


def test_environments_whose_rewards_hindsight_cannot_use_are_refused() -> None:
    scaled = gym.wrappers.TransformReward(make_env("FetchReach-v4"), lambda r: 2 * float(r))
    for env, message in (
        (make_env("HandManipulatePen-v1"), "must be 0 if compute_reward.*HandManipulatePen-v1"),
        (scaled, "a step returned reward -2, compute_reward gives -1"),
        (make_env("Pendulum-v1"), "must be 0 without a goal environment: Pendulum-v1"),
    ):
        with pytest.raises(ValueError, match=message):
            goal_reward_of(env)


# --- docs/add_an_environment.md ----------------------------------------------------------------

PAGE = (Path(__file__).parents[3] / "docs" / "add_an_environment.md").read_text(encoding="utf-8")


def test_the_checks_of_the_page_hold() -> None:
    checks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert checks
    exec("\n".join(checks), {})


def test_the_declarations_of_the_page_fit_their_environments(tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    examples = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert examples
    for example in examples:
        path.write_text(example, encoding="utf-8")
        check_environments(make_plan(load_config(path)))


# --- training ----------------------------------------------------------------------------------


def run_settings(variant: Variant, *, hindsight_k: float = 0.0) -> RunSettings:
    task = BUILT_IN_TASKS["HandManipulateBlock"]
    return RunSettings.model_validate(
        {
            "task": task,
            "variant": variant,
            "seed": 0,
            "env_steps": 2 * task.horizon,
            "num_envs": 1,
            "evaluation": Evaluation(interval=2 * task.horizon, episodes=2),
            "tac": {
                "hidden_sizes": (16, 16),
                "batch_size": 32,
                "random_steps": task.horizon,
                "replay_ratio": 0.2,
            },
            "music": variant_music(variant, task)
            | ({"batch_trajectories": 4} if variant != "tac" else {}),
            "replay": {"capacity": 1_000, "hindsight_k": hindsight_k},
        }
    )


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("variant, hindsight_k", [("music-u", 0.0), ("tac", 4.0)])
def test_the_hand_trains_to_the_end_of_its_budget(variant: Variant, hindsight_k: float) -> None:
    from music_rllib.training.run import TrainingRun

    training = TrainingRun(run_settings(variant, hindsight_k=hindsight_k))
    metrics: dict[str, float] = {}
    while not training.finished:
        metrics |= training.advance()
    modules = training.network_weights()
    training.close()
    assert metrics[names.ENV_STEPS] == 200
    assert metrics[names.GRAD_UPDATES] == 20
    assert metrics[names.EVAL_EPISODES] == 2
    assert 0.0 <= metrics[names.EVAL_SUCCESS] <= metrics[names.EVAL_SUCCESS_ANY] <= 1.0
    assert -100.0 <= metrics[names.EVAL_RETURN] <= 0.0
    # The block lies in the palm: every movement of the fingers moves it by centimeters.
    assert 0.001 < metrics[names.TRAIN_DISPLACEMENT] < 1.0
    assert np.isfinite(list(metrics.values())).all()
    assert ("mi_estimator" in modules) == (variant == "music-u")
    if variant == "music-u":
        assert -1.0 <= metrics[names.MI_REWARD] <= 0.0
        assert modules["mi_estimator"]["agent.weight"].shape == (128, 24)
        assert modules["mi_estimator"]["surrounding.weight"].shape == (128, 3)
