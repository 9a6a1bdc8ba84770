"""Make environments, and seed their episodes."""

from __future__ import annotations

import contextlib
import copy
import mmap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from music_rllib.envs.tasks import (
    BUILT_IN_TASKS,
    LAST_SEED,
    Task,
    make_importable,
    register_robotics,
)

Env = gym.Env[Any, Any]
Floats = NDArray[np.float32]


def make_env(env_id: str, /, **kwargs: Any) -> Env:
    """Make a Gymnasium environment by its id, with the robotics tasks registered.

    The Fetch tasks get a faster step with the same results (`music_rllib.envs.fetch`). `close()`
    of the returned environment ignores exceptions, since nothing depends on it.

    Raises:
        gymnasium.error.Error: The id or an argument is unknown.
        ImportError: The module in front of the id is not found (`music_rllib.envs.tasks`).
    """
    register_robotics()
    if ":" in env_id:
        make_importable(env_id.partition(":")[0])
    # The checker takes a tenth of every step, and helps only an environment's authors. An
    # environment may change its arguments, which are those of the next one.
    env = gym.make(env_id, disable_env_checker=True, **copy.deepcopy(kwargs))
    from music_rllib.envs.fetch import speed_up  # after the notice is dropped

    speed_up(env)
    own = env.close

    def close() -> None:
        with contextlib.suppress(Exception):
            own()  # type: ignore[no-untyped-call]

    env.close = close  # type: ignore[method-assign]
    return env


def name_of(env: Env) -> str:
    """The environment's id, or its class if it has no id."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


class Known(NamedTuple):
    """An environment that may be made, because no file chose its code and arguments."""

    env_id: str
    kwargs: Mapping[str, Any]


def known_environment(task: Task, user_tasks: Iterable[Task] = ()) -> Known | None:
    """The environment of a task from a file; None if the file would choose the code that runs.

    Known are the environments of the built-in tasks and of `user_tasks`, and those of Gymnasium and
    Gymnasium-Robotics without arguments, which may name files.
    """
    for trusted in (*BUILT_IN_TASKS.values(), *user_tasks):
        if (trusted.env_id, trusted.env_kwargs) == (task.env_id, task.env_kwargs):
            return Known(trusted.env_id, trusted.env_kwargs)
    # Looking up an id with a module in front would import the module.
    if ":" in task.env_id:
        return None
    if task.env_id not in gym.registry:
        with contextlib.suppress(gym.error.DependencyNotInstalled):  # the policy can still act
            register_robotics()
    spec = gym.registry.get(task.env_id)
    if spec is None or task.env_kwargs or not isinstance(spec.entry_point, str):
        return None
    package = spec.entry_point.partition(":")[0].partition(".")[0]
    return Known(task.env_id, {}) if package in {"gymnasium", "gymnasium_robotics"} else None


def is_gymnasium_id(env: object) -> bool:
    """Whether `env` is a Gymnasium id, with or without `module:`, not a Ray id or a class."""
    register_robotics()
    return isinstance(env, str) and (":" in env or env in gym.registry)


def episode_limit(env: Env, setting: int | None) -> int:
    """Length of the longest episode: the smaller of `setting` and the environment's own limit."""
    limits = [setting, env.spec.max_episode_steps if env.spec is not None else None]
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    found = [limit for limit in limits if limit is not None]
    if not found:
        raise ValueError(
            "tac.max_episode_steps must be set: the environment has no time limit of its own"
        )
    return min(found)


def reset_seed(
    entropy: np.random.SeedSequence, seed_range: tuple[int, int] = (0, LAST_SEED)
) -> int:
    """Seed of an episode's reset, from the smallest to the largest of `seed_range`."""
    smallest, largest = seed_range
    return smallest + (int(entropy.generate_state(1)[0]) >> 1) % (largest - smallest + 1)


class CallCounter:
    """A counter that is odd during `with in_environment: env.step(...)`; costs 0.2 us.

    An environment may hang while it holds Python's lock, so another process watches the counter in
    a shared file.
    """

    BYTES = 8

    def __init__(self) -> None:
        self.unshare()

    def __enter__(self) -> None:
        self._number[0] += 1

    def __exit__(self, *_: object) -> None:
        self._number[0] += 1

    def share(self, path: Path) -> None:
        """Move the counter to a file; not during a call of an environment."""
        path.write_bytes(bytes(self.BYTES))
        with path.open("r+b") as file:
            self._number = memoryview(mmap.mmap(file.fileno(), self.BYTES)).cast("q")

    def unshare(self) -> None:
        """Move the counter to this process's own memory."""
        self._number = memoryview(bytearray(self.BYTES)).cast("q")


in_environment = CallCounter()
"""The counter of this process, which calls its environments one after another."""
