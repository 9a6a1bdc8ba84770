"""Episodes of a policy in its task."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from music_rllib.envs.features import beyond_observation
from music_rllib.envs.make import Env, make_env, name_of, reset_seed
from music_rllib.envs.values import (
    GOAL_KEYS,
    check_action_space,
    flag_of,
    number_of,
    observation_sizes,
    success_of,
)
from music_rllib.errors import first_line, one_line
from music_rllib.policy.policy import Policy, PolicyError, unknown_environment


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """The result of one episode; None if the task does not define a value."""

    seed: int
    success: bool | None
    """Success at the last step, which success rates count."""
    success_any_step: bool | None
    episode_return: float
    env_steps: int
    object_displacement: float | None
    """Distance between the surroundings' first and last state (meters in the Fetch tasks)."""


class EpisodeStep(NamedTuple):
    """The state of an episode after its reset or a step, for a video."""

    env: Env
    step: int
    success: bool | None
    """None before the first step, and if the task does not define it."""
    distance: float | None
    """Distance between achieved and desired goal."""


def open_task(policy: Policy, **options: Any) -> Env:
    """Make the policy's environment; `options` override the task's arguments of `gymnasium.make`.

    Raises:
        PolicyError: Only the policy's file names it, it can't be made, or it does not fit.
    """
    known = policy.environment
    if known is None:
        raise PolicyError(unknown_environment(policy.task))
    try:
        env = make_env(known.env_id, **{**known.kwargs, **options})
    except Exception as error:  # of the user's own constructor
        raise PolicyError(
            f"the environment {known.env_id} must be there: {_reason(error)}"
        ) from error
    try:
        _check_fit(policy, env)
    except ValueError as error:
        env.close()
        raise PolicyError(f"{known.env_id} must fit the policy: {error}") from error
    return env


def _check_fit(policy: Policy, env: Env) -> None:
    """Raise ValueError for an environment with other observations, goals or actions."""
    actions = check_action_space(env.action_space).shape
    theirs = (*observation_sizes(env.observation_space), *actions)
    ours = (policy.observation_size, policy.goal_size, policy.action_size)
    if theirs != ours:
        raise ValueError(f"it has observations, goals and actions of {theirs}, the policy {ours}")
    # The agent's are not read.
    if beyond := beyond_observation((), policy.task.surrounding_indices, policy.observation_size):
        raise ValueError(beyond[0])


def play(
    policy: Policy,
    env: Env,
    episodes: int,
    seed: int,
    on_step: Callable[[EpisodeStep], None] | None = None,
) -> Iterator[EpisodeResult]:
    """Play `episodes` deterministic episodes in an environment of `open_task`.

    Equal seeds give equal starts and goals. `on_step` is called after each reset and step.
    """
    for number in range(episodes):
        entropy = np.random.SeedSequence((seed, number))
        yield _episode(policy, env, reset_seed(entropy, policy.task.seed_range), on_step)


@contextlib.contextmanager
def _named(env: Env, seed: int, step: int) -> Iterator[None]:
    """Name the episode and the step in an error of the environment."""
    try:
        yield
    except Exception as error:  # of the user's own code
        place = f"{name_of(env)}, episode with seed {seed}, step {step}"
        raise PolicyError(f"{place}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """The message of an error; with its type if the message may not say enough."""
    plain = isinstance(error, ValueError | ImportError | gym.error.Error)
    return first_line(error) if plain else one_line(error)


def _episode(
    policy: Policy, env: Env, seed: int, on_step: Callable[[EpisodeStep], None] | None
) -> EpisodeResult:
    with _named(env, seed, 0):
        observation, _ = env.reset(seed=seed)
    first, total, successes = _surroundings(policy, observation), 0.0, []
    if on_step:
        on_step(EpisodeStep(env, 0, None, _distance(observation)))
    steps = 0
    for steps in range(1, policy.max_episode_steps + 1):
        with _named(env, seed, steps):
            # A bound may lie between two numbers of the policy's precision.
            bounds = check_action_space(env.action_space)
            action = np.clip(policy.act(observation).astype(bounds.dtype), bounds.low, bounds.high)
            observation, reward, terminated, truncated, info = env.step(action)
            total += number_of(reward, "reward")
            success = success_of(info, policy.task.success_key, missing=False)
            ends = flag_of(terminated, "terminated") or flag_of(truncated, "truncated")
        if success is not None:
            successes.append(success)
        if on_step:
            on_step(EpisodeStep(env, steps, success, _distance(observation)))
        if ends:
            break
    last = _surroundings(policy, observation)
    return EpisodeResult(
        seed=seed,
        success=successes[-1] if successes else None,
        success_any_step=any(successes) if successes else None,
        episode_return=total,
        env_steps=steps,
        object_displacement=None if last is None else float(np.linalg.norm(last - first)),
    )


def _surroundings(policy: Policy, observation: Any) -> NDArray[Any] | None:
    indices = list(policy.task.surrounding_indices)
    if not indices:
        return None
    flat = observation["observation"] if policy.goal_size else observation
    return np.asarray(flat, np.float64)[indices]  # unsigned numbers would wrap around


def _distance(observation: Any) -> float | None:
    if not isinstance(observation, dict):
        return None
    achieved, desired = (np.asarray(observation[key], np.float64) for key in GOAL_KEYS[1:])
    return float(np.linalg.norm(achieved - desired))
