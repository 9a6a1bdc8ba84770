"""Makes environments, and gets from them what the learner needs to know."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.envs.farama_notice import drop_farama_notice
from music_rllib.envs.goal_rewards import Unlike, directions, first_unlike, lost_by_rounding
from music_rllib.envs.modules import make_importable
from music_rllib.envs.numbers import LARGEST, BadNumberError, are_usable, check_numbers
from music_rllib.envs.recording import Recording
from music_rllib.envs.tasks import BUILT_IN_TASKS, LAST_SEED, Task
from music_rllib.errors import first_line, in_words
from music_rllib.replay.buffer import GoalReward
from music_rllib.replay.trajectories import ReplayLayout

Env = gym.Env[Any, Any]


@functools.cache
def _register_robotics() -> None:
    """Registers the robotics tasks with Gymnasium, without their package's notice.

    Raises:
        gymnasium.error.DependencyNotInstalled: MuJoCo can't be imported.
    """
    drop_farama_notice()
    try:
        import gymnasium_robotics
    # With a way of drawing that the machine has not, errors of any type.
    except Exception as error:
        way = os.environ.get("MUJOCO_GL")
        if way is None:
            raise
        raise gym.error.DependencyNotInstalled(
            f"MuJoCo can't be loaded with MUJOCO_GL={way} ({error}): unset it, or install what it "
            "needs (Debian: libosmesa6 for osmesa, libegl1 for egl)"
        ) from error

    gym.register_envs(gymnasium_robotics)


def make_env(env_id: str, **kwargs: Any) -> Env:
    """Makes a Gymnasium environment by its id, with the robotics tasks registered.

    The Fetch tasks get a faster step with the same results (`music_rllib.envs.fetch`). Its
    `close()` ignores exceptions, since nothing depends on it. Raises `gymnasium.error.Error` for
    unknown ids and arguments, and ImportError for a module in front of the id that is not found
    (`music_rllib.envs.modules`).
    """
    _register_robotics()
    if ":" in env_id:
        make_importable(env_id.partition(":")[0])
    # The checker takes a tenth of every step, and helps only an environment's authors.
    env = gym.make(env_id, disable_env_checker=True, **kwargs)
    from music_rllib.envs.fetch import speed_up  # after the notice is dropped

    speed_up(env)
    own = env.close

    def close() -> None:
        with contextlib.suppress(Exception):
            own()  # type: ignore[no-untyped-call]

    env.close = close  # type: ignore[method-assign]
    return env


class Known(NamedTuple):
    """An environment that may be made, because no file chose its code and arguments."""

    env_id: str
    kwargs: Mapping[str, Any]


def known_environment(task: Task, vouched: Iterable[Task] = ()) -> Known | None:
    """The environment of a task from a file; None where the file would choose the code that runs.

    Known are the environments of the built-in tasks and of the user's (`vouched`), and those of
    Gymnasium and Gymnasium-Robotics without arguments, which may name files.
    """
    for trusted in (*BUILT_IN_TASKS.values(), *vouched):
        if (trusted.env_id, trusted.env_kwargs) == (task.env_id, task.env_kwargs):
            return Known(trusted.env_id, trusted.env_kwargs)
    # An id with a module in front would import the module before anything is checked.
    if ":" in task.env_id:
        return None
    if task.env_id not in gym.registry:
        with contextlib.suppress(gym.error.DependencyNotInstalled):  # the policy acts all the same
            _register_robotics()
    spec = gym.registry.get(task.env_id)
    if spec is None or task.env_kwargs or not isinstance(spec.entry_point, str):
        return None
    package = spec.entry_point.partition(":")[0].partition(".")[0]
    return Known(task.env_id, {}) if package in {"gymnasium", "gymnasium_robotics"} else None


def reset_seed(
    entropy: np.random.SeedSequence, seed_range: tuple[int, int] = (0, LAST_SEED)
) -> int:
    """Seed of an episode's reset, from the smallest to the largest of `seed_range`.

    Environments often keep it in a signed 32-bit integer.
    """
    smallest, largest = seed_range
    return smallest + (int(entropy.generate_state(1)[0]) >> 1) % (largest - smallest + 1)


def is_gymnasium_id(env: object) -> bool:
    """Whether `env` is a Gymnasium id, with `module:` in front or not; no Ray id, and no class."""
    _register_robotics()
    return isinstance(env, str) and (":" in env or env in gym.registry)


def observation_sizes(space: gym.Space[Any]) -> tuple[int, int]:
    """Features of observation and goal (0 without goals); ValueError for other spaces."""
    if _is_flat(space):
        return int(space.shape[0]), 0  # type: ignore[index]
    if isinstance(space, spaces.Dict):
        parts = {name: space.spaces.get(name) for name in _GOAL_KEYS}
        if all(_is_flat(part) for part in parts.values()):
            sizes = [int(part.shape[0]) for part in parts.values()]  # type: ignore[union-attr,index]
            if sizes[1] == sizes[2]:
                return sizes[0], sizes[1]
    raise ValueError(
        "environment: the observation space must be a one-dimensional Box, or a Dict with "
        f"one-dimensional {', '.join(_GOAL_KEYS)} (goals of equal size), got {space}"
    )


_GOAL_KEYS = ("observation", "desired_goal", "achieved_goal")


def _is_flat(space: gym.Space[Any] | None) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def check_action_space(space: gym.Space[Any]) -> spaces.Box:
    """Returns the space; raises ValueError unless it is a bounded one-dimensional Box of floats.

    The policy acts between the bounds: between huge ones, which stand for none, it could choose
    no ordinary action.
    """
    if not (
        isinstance(space, spaces.Box)
        and len(space.shape) == 1
        and space.is_bounded("both")
        and np.issubdtype(space.dtype, np.floating)
    ):
        raise ValueError(
            "environment: the action space must be a bounded one-dimensional Box of floats, got "
            f"{space}"
        )
    if np.abs(np.array([space.low, space.high], np.float64)).max(initial=0.0) > LARGEST:
        raise ValueError(
            f"environment: the action space's bounds must be within +-{LARGEST:g}, got {space}; "
            "declare the range that the environment uses, since the policy's actions fill it"
        )
    return space


def to_bounds(actions: NDArray[np.float32], space: spaces.Box) -> NDArray[Any]:
    """Actions [B, A] in [-1, 1], scaled to the bounds of `check_action_space` and of its type."""
    # The range of a float16 may be no float16.
    wide = np.result_type(space.low.dtype, np.float32)
    low, high = space.low.astype(wide, copy=False), space.high.astype(wide, copy=False)
    scaled = low + (actions + 1.0) * 0.5 * (high - low)
    return np.asarray(np.clip(scaled, low, high).astype(space.dtype))


def episode_limit(env: Env, setting: int | None) -> int:
    """Steps of the longest episode: the smaller of `setting` and the environment's own limit."""
    own = env.spec.max_episode_steps if env.spec is not None else None
    limits = [limit for limit in (setting, own) if limit is not None]
    if not limits:
        raise ValueError(
            "tac.max_episode_steps must be set: the environment has no time limit of its own"
        )
    return min(limits)


def compute_reward_of(env: Env) -> GoalReward | None:
    """The environment's `compute_reward` as a function of goals, unchecked; None without one."""
    compute = getattr(env.unwrapped, "compute_reward", None)
    if compute is None or not isinstance(env.observation_space, spaces.Dict):
        return None

    def reward(achieved: NDArray[np.float32], desired: NDArray[np.float32]) -> NDArray[Any]:
        rewards = np.asarray(compute(achieved, desired, {}), dtype=np.float32)
        if not are_usable(rewards.ravel()):
            check_numbers([("compute_reward", rewards.ravel())], name_of(env))
        return rewards

    return reward


def goal_reward_of(env: Env, seed: int = 0) -> GoalReward:
    """The environment's reward as a vectorised function of achieved and desired goals.

    Resets `env` with `seed` and takes some random steps in it to check the function: HER would
    silently learn from wrong rewards (HandManipulatePen of Gymnasium-Robotics 1.4.2 mixes up the
    rows of a batch). Raises ValueError where a row's reward depends on more than its goals, is not
    what a step gives, or is lost where goals are rounded to float32.
    """
    reward = compute_reward_of(env)
    if reward is None:
        raise ValueError(
            "replay.hindsight_k must be 0 without a goal environment: "
            f"{name_of(env)} has no goals with a compute_reward"
        )
    try:
        problem = _problem_of(reward, env, seed)
    except BadNumberError as error:
        raise ValueError(first_line(error)) from error
    except Exception as error:
        problem = _BY_ROW, f"it raises {in_words(error)}"
    if problem:
        rule, reason = problem
        raise ValueError(
            f"replay.hindsight_k must be 0 where {rule}: with {name_of(env)}, {reason}"
        )
    return reward


_BY_ROW = "compute_reward does not compute each row of a batch independently"
_WHOLE = "compute_reward is not the whole reward of a step"
_KEPT = "goals lose digits in float32 on which rewards depend"


MOVED_SHARE = 0.2
"""Share of a task's success distance from which an achieved goal counts as moved: 1 cm in the Fetch
tasks, as for the metric `evaluation/object_moved_share`."""


def moved_distance_of(env: Env, reward: GoalReward, seed: int = 0) -> float | None:
    """The distance between achieved goals for `hindsight_episodes: moved`; resets `env`.

    None where the reward decides: a sparse one does not change within the success distance. A dense
    one changes even with the jitter of a resting object, and needs a `distance_threshold`.
    """
    start = np.asarray(env.reset(seed=seed)[0]["achieved_goal"], np.float32)[None]
    jitter = np.float32(1e-6) * np.maximum(1.0, np.abs(start))
    if np.array_equal(reward(start, start + jitter), reward(start, start)):
        return None
    distance = getattr(env.unwrapped, "distance_threshold", None)
    if isinstance(distance, int | float) and distance > 0:
        return MOVED_SHARE * distance
    raise ValueError(
        "replay.hindsight_episodes must be all, or the task must have a moved_distance: "
        f"{name_of(env)} has dense rewards and no distance_threshold, so any jitter is a move"
    )


_TRIED_STEPS = 20
"""Most random steps whose rewards are compared before training; then each episode's are."""


def _problem_of(reward: GoalReward, env: Env, seed: int) -> tuple[str, str] | None:
    """The rule that the rewards of goals around the first achieved one break, and how."""
    first, rows = env.reset(seed=seed)[0], 256
    start = np.asarray(first["achieved_goal"])
    distance = float(np.linalg.norm(start - first["desired_goal"])) or 1.0
    achieved = np.tile(start.astype(np.float32), (rows, 1))
    # From within any threshold to far beyond it.
    offsets = max(1.0, distance) * directions(rows, len(start), 1e-3 / max(1.0, distance), 1.0)
    desired = (achieved + offsets).astype(np.float32)
    together = reward(achieved, desired)
    unlike = _play_some(reward, env, first)
    alone = [reward(achieved[i : i + 1], desired[i : i + 1]) for i in range(rows)]
    apart = np.abs(together - np.concatenate(alone)) if together.shape == (rows,) else np.ones(1)
    if not apart.max() <= 1e-5 * np.abs(together).max():
        return _BY_ROW, "rewards change with the batch or the simulator"
    if unlike:
        return _WHOLE, unlike.problem
    lost = lost_by_rounding(reward, start, distance)
    return (_KEPT, lost) if lost else None


def _play_some(reward: GoalReward, env: Env, first: Any) -> Unlike | None:
    """Play some random steps; the first whose reward is not that of its goals."""
    observation, goal = observation_sizes(env.observation_space)
    space, rng = check_action_space(env.action_space), np.random.default_rng(0)
    size = int(space.shape[0])
    layout = ReplayLayout(observation=observation, action=size, goal=goal, horizon=_TRIED_STEPS)
    recording = Recording(layout, name=name_of(env))
    recording.see(first)
    terminated = truncated = False
    while recording.steps < layout.horizon and not (terminated or truncated):
        action = rng.uniform(-1.0, 1.0, (1, size)).astype(np.float32)
        after, given, terminated, truncated, info = env.step(to_bounds(action, space)[0])
        recording.step(action[0], given, info, after)
    episode = recording.finish(terminated=bool(terminated))
    return first_unlike(reward, episode.frames[:, observation:], episode.rewards)


def name_of(env: Env) -> str:
    """The environment's id, or its class where it has none."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
