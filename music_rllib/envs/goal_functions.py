"""The functions of goals that hindsight and symmetries use, checked before they are used.

Shape legend: B rows of a batch, G goal features.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.envs.episodes import Recording, lost_by_rounding, random_offsets
from music_rllib.envs.features import Augmentation, Symmetries, Symmetry
from music_rllib.envs.make import Env, in_environment, name_of, reset_seed
from music_rllib.envs.tasks import (
    LAST_SEED,
)
from music_rllib.envs.values import (
    BadNumberError,
    are_usable,
    check_action_space,
    check_numbers,
    flag_of,
    observation_sizes,
    to_bounds,
)
from music_rllib.errors import first_line, one_line
from music_rllib.replay.buffer import GoalEnd, GoalReward
from music_rllib.replay.trajectories import ReplayLayout, Transitions

Floats = NDArray[np.float32]


def compute_reward_of(env: Env) -> GoalReward | None:
    """The environment's `compute_reward` as a function of goals, unchecked; None without one."""
    compute = _outermost(env, "compute_reward")
    if compute is None:
        return None

    def reward(achieved: NDArray[np.float32], desired: NDArray[np.float32]) -> NDArray[Any]:
        rewards = np.asarray(compute(np.array(achieved), np.array(desired), {}), np.float32)
        if not are_usable(rewards.ravel()):
            try:
                check_numbers("compute_reward", rewards.ravel())
            except ValueError as error:
                raise BadNumberError.at(name_of(env), error) from None
        return rewards

    return reward


def goal_reward_of(env: Env, seed_range: tuple[int, int] = (0, LAST_SEED)) -> GoalReward:
    """The environment's `compute_reward` as a function of goals [B, G], checked.

    Resets `env` with seeds of `seed_range` and takes some random steps. Without these checks,
    hindsight would learn from wrong rewards (HandManipulatePen of Gymnasium-Robotics 1.4.2 mixes up
    the rows of a batch).

    Raises:
        ValueError: A row's reward depends on more than its goals, is not the reward of a step, or
            is lost if goals are rounded to float32.
    """
    reward = compute_reward_of(env)
    if reward is None:
        raise ValueError(
            "replay.hindsight_k must be 0 without a goal environment: "
            f"{name_of(env)} has no goals with a compute_reward"
        )
    try:
        problem = _problem_of(reward, env, seed_range)
    except BadNumberError as error:
        raise ValueError(first_line(error)) from error
    except Exception as error:
        problem = _BY_ROW, f"it raises {one_line(error)}"
    if problem:
        rule, reason = problem
        raise ValueError(f"replay.hindsight_k must be 0 if {rule}: with {name_of(env)}, {reason}")
    return reward


_BY_ROW = "compute_reward does not compute each row of a batch independently"
_KEPT = "goals lose digits in float32 on which rewards depend"
_BY_GOALS = "compute_reward depends on more than its goals"
_TRIED_EPISODES = 3
"""Number of further episodes in which the same goals must have the same rewards."""
_ROWS = 256
"""Number of goals whose rewards are compared before training."""
_TRIED_STEPS = 20
"""Maximum number of random steps whose rewards are compared before training."""


def _problem_of(
    reward: GoalReward, env: Env, seed_range: tuple[int, int]
) -> tuple[str, str] | None:
    """The rule that rewards of goals around the first achieved one break, and how.

    Raises:
        BadNumberError: A step has another reward than its goals.
    """
    first = _reset(env, seed_range[0])
    start, distance, achieved, desired = _goals_near(first)
    together = reward(achieved, desired)
    if together.shape != (_ROWS,):
        return _BY_ROW, f"{_ROWS} goals have rewards of shape {together.shape}"
    played = _play_some(reward, env, first)  # a reward may depend on the simulator's state
    alone = [reward(achieved[i : i + 1], desired[i : i + 1]) for i in range(_ROWS)]
    tolerance = 1e-5 * np.abs(together).max()
    if not np.abs(together - np.concatenate(alone)).max() <= tolerance:
        return _BY_ROW, "rewards change with the batch or the simulator"
    reached = played.finish(terminated=False).frames[:, -len(start) :]
    distances = [distance, float(np.linalg.norm(reached - reached[0], axis=1).max())]
    for number in range(_TRIED_EPISODES):  # one function computes the rewards of all episodes
        again = _reset(env, reset_seed(np.random.SeedSequence(number), seed_range))
        distances.append(_distance(again))
        if not np.abs(together - reward(achieved, desired)).max() <= tolerance:
            return _BY_GOALS, "rewards of the same goals change from episode to episode"
    # A goal may begin near the achieved one: those of hindsight lie as far away as the agent gets.
    lost = lost_by_rounding(reward, start, max(distances))
    return (_KEPT, lost) if lost else None


def _reset(env: Env, seed: int) -> Any:
    """The first observation; a call that hangs ends the worker, as in training."""
    with in_environment:
        return env.reset(seed=seed)[0]


def _goals_near(first: Any) -> tuple[NDArray[Any], float, Floats, Floats]:
    """The achieved goal of a first observation, its distance to the desired one, goals [256, G].

    The achieved goals are all that of `first`; the desired ones lie from within any threshold to
    far beyond it.
    """
    start = np.asarray(first["achieved_goal"], np.float64)
    distance = _distance(first)
    achieved = np.tile(start.astype(np.float32), (_ROWS, 1))
    longest = max(1.0, distance)
    offsets = longest * random_offsets(_ROWS, len(start), 1e-3 / longest, 1.0)
    return start, distance, achieved, (achieved + offsets).astype(np.float32)


def _distance(observation: Any) -> float:
    """Distance of achieved and desired goal; 1 if they are equal."""
    achieved, desired = (
        np.asarray(observation[key], np.float64) for key in ("achieved_goal", "desired_goal")
    )
    return float(np.linalg.norm(achieved - desired)) or 1.0


def _outermost(env: Env, name: str) -> Any:
    """The outermost function `name` of a goal environment and its wrappers; None without."""
    if isinstance(env.observation_space, spaces.Dict):
        with contextlib.suppress(AttributeError):
            return env.get_wrapper_attr(name)
    return None


def compute_terminated_of(env: Env) -> GoalEnd | None:
    """The environment's `compute_terminated`, called for one row after another; None without it."""
    compute = _outermost(env, "compute_terminated")
    if compute is None:
        return None

    def ends(achieved: Floats, desired: Floats) -> NDArray[np.bool_]:
        pairs = zip(np.array(achieved), np.array(desired), strict=True)
        flags = [flag_of(compute(*pair, {}), "compute_terminated") for pair in pairs]
        return np.array(flags, np.bool_)

    return ends


def goal_end_of(env: Env, seed: int = 0) -> GoalEnd | None:
    """Where the environment ends an episode because of its goals; None if it never does.

    Only environments of Gymnasium-Robotics are known to never end if no tried goal ends them:
    another one may end at goals that are first achieved later, such as a lifted object.
    Resets `env` with `seed`.

    Raises:
        ValueError: `compute_terminated` does not compute a flag from two goals.
    """
    by_row = compute_terminated_of(env)
    if by_row is None:
        return None
    _, _, start, near = _goals_near(_reset(env, seed))
    achieved, desired = np.concatenate([start, near, near]), np.concatenate([near, start, near])
    try:
        expected = by_row(achieved, desired)
    except Exception as error:
        raise ValueError(
            "replay.hindsight_k must be 0 if compute_terminated does not compute a flag from two "
            f"goals: with {name_of(env)}, it raises {one_line(error)}"
        ) from error
    compute = _outermost(env, "compute_terminated")
    if not expected.any() and compute.__module__.startswith("gymnasium_robotics."):
        return None

    def together(achieved: Floats, desired: Floats) -> NDArray[np.bool_]:
        return np.asarray(compute(np.array(achieved), np.array(desired), {}), np.bool_)

    with contextlib.suppress(Exception):  # it may take single goals only, and is slower then
        if np.array_equal(together(achieved, desired), expected):
            return together
    return by_row


def _play_some(reward: GoalReward, env: Env, first: Any) -> Recording:
    observation, goal = observation_sizes(env.observation_space)
    space, rng = check_action_space(env.action_space), np.random.default_rng(0)
    layout = ReplayLayout(observation, int(space.shape[0]), goal, _TRIED_STEPS)
    recording = Recording(layout, name=name_of(env), goal_reward=reward)
    recording.see(first)
    ended = False
    while recording.steps < layout.horizon and not ended:
        action = rng.uniform(-1.0, 1.0, (1, layout.action)).astype(np.float32)
        with in_environment:
            after, given, terminated, truncated, info = env.step(to_bounds(action, space)[0])
        recording.step(action[0], given, info, after)
        ended = terminated or truncated
    return recording


def augmentation_of(
    symmetries: Symmetries, used: Collection[Symmetry], layout: ReplayLayout, env: Env,
    *, reward: GoalReward | None = None, goals: bool = True, seed: int = 0,
) -> Augmentation:  # fmt: skip
    """The task's symmetries for a replay, checked against rewards; False if all `goals` are 0.

    Resets `env` if rewards are checked: `reward`, or the environment's `compute_reward`.

    Raises:
        ValueError: They do not fit the environment, or change rewards.
    """
    augmentation = Augmentation(symmetries, used, layout, goals=goals)
    known, reward = reward, reward or compute_reward_of(env)
    if reward is None or not goals:
        return augmentation
    start = np.asarray(_reset(env, seed)["achieved_goal"], np.float32)
    rows = 256
    inputs = np.zeros((2, rows, layout.network_input), np.float32)
    inputs[:, :, layout.observation :] = start
    inputs[1, :, layout.observation :] += random_offsets(rows, layout.goal, 1e-3, 1.0)
    achieved, desired = inputs[:, :, layout.observation :]
    try:
        rewards = reward(achieved, desired)
    except Exception:
        if known is None:
            return augmentation
        raise
    # Without hindsight it need not be a function of goals.
    if known is None and not np.array_equal(reward(achieved, desired), rewards):
        return augmentation
    none = np.zeros(rows, np.float32)
    actions = np.zeros((rows, layout.action), np.float32)
    changed = Transitions(inputs[0], actions, none, none, inputs[1], None, np.arange(rows))
    augmentation(np.random.default_rng(0), changed)
    # A few goals may lie so near a threshold that rounding decides.
    if np.mean(~np.isclose(reward(achieved, desired), rewards, rtol=1e-3, atol=1e-4)) > 0.02:
        raise ValueError(
            f"replay.symmetries must keep rewards: with {name_of(env)}, compute_reward differs if "
            "both goals change; see `goal` of the task's symmetries"
        )
    return augmentation


MOVED_SHARE = 0.2
"""Share of a task's success distance from which an achieved goal counts as moved: 1 cm in the Fetch
tasks, as for the metric `evaluation/object_moved_share`."""


def moved_distance_of(env: Env, reward: GoalReward, seed: int = 0) -> float | None:
    """Distance between achieved goals that counts as moved for `hindsight_episodes: moved`.

    None if the reward decides, as a sparse reward does not change within the success distance. A
    dense reward changes with every jitter of a resting object, so it needs the environment's
    `distance_threshold`. Resets `env`.

    Raises:
        ValueError: The reward is dense, and there is no `distance_threshold`.
    """
    start = np.asarray(_reset(env, seed)["achieved_goal"], np.float32)[None]
    jitter = np.float32(1e-6) * np.maximum(1.0, np.abs(start))
    # A smooth reward, such as exp(-distance**2), is flat within float32 next to the goal.
    near = [reward(start, start + np.float32(times) * jitter) for times in (1, 10, 100, 1000)]
    if all(np.array_equal(each, reward(start, start)) for each in near):
        return None
    distance = getattr(env.unwrapped, "distance_threshold", None)
    if isinstance(distance, int | float | np.number) and distance > 0:
        return MOVED_SHARE * float(distance)
    raise ValueError(
        "replay.hindsight_episodes must be all, or the task must have a moved_distance: "
        f"{name_of(env)} has dense rewards and no distance_threshold, so any jitter is a move"
    )
