"""Checks of an environment's spaces and of the values that it returns.

A NaN would spread to every weight, and NumPy would repeat a single number or read numbers from
text. All functions raise ValueError; callers add the environment and the step.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from music_rllib.errors import shorten

LARGEST = 1e15
"""Largest accepted number. Returns are up to 100 times as large, and the sum of their squared
errors over a minibatch must be within float32's range."""
GOAL_KEYS = ("observation", "desired_goal", "achieved_goal")
"""Keys of a goal environment's observation that the networks and hindsight use."""


class BadNumberError(RuntimeError):
    """An environment or a policy returned a value that can't be learned from."""

    @classmethod
    def at(cls, place: str, problem: object) -> BadNumberError:
        """The error for a `problem` with an environment's values; `place` names the step."""
        return cls(
            f"{place}: {problem}\n"
            "The run stops before anything is learned from it; its last checkpoint is good."
        )


def check_torch_type() -> None:
    """Raise ValueError if an environment or its module changed PyTorch's default type; undo it."""
    torch = sys.modules.get("torch")
    if torch is None or (found := torch.get_default_dtype()) is torch.float32:
        return
    torch.set_default_dtype(torch.float32)
    raise ValueError(
        "PyTorch's default type must stay float32, the type of the networks, got "
        f"{str(found).removeprefix('torch.')}: an environment or its module calls "
        "torch.set_default_dtype"
    )


# -- spaces -----------------------------------------------------------------------------------


def observation_sizes(space: gym.Space[Any]) -> tuple[int, int]:
    """Number of features of observation and goal; the goal has 0 in a plain `Box`."""
    if _is_flat(space):
        return int(space.shape[0]), 0  # type: ignore[index]
    if isinstance(space, spaces.Dict):
        parts = [space.spaces.get(name) for name in GOAL_KEYS]
        if all(map(_is_flat, parts)):
            observation, desired, achieved = (int(part.shape[0]) for part in parts)  # type: ignore[union-attr,index]
            if desired == achieved:
                return observation, desired
    raise ValueError(
        "environment: the observation space must be a one-dimensional Box, or a Dict with "
        f"one-dimensional {', '.join(GOAL_KEYS)} (goals of equal size), got {space}"
    )


def _is_flat(space: gym.Space[Any] | None) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def check_action_space(space: gym.Space[Any]) -> spaces.Box:
    """Return the space if it is a one-dimensional, non-empty Box of floats within +-`LARGEST`.

    The policy's actions fill the bounds; with placeholder bounds, nearly every action is huge.
    """
    if not (
        isinstance(space, spaces.Box)
        and _is_flat(space)
        and space.shape[0] > 0
        and space.is_bounded("both")
        and np.issubdtype(space.dtype, np.floating)
    ):
        raise ValueError(
            "environment: the action space must be a bounded one-dimensional Box of one or more "
            f"floats, got {space}"
        )
    if np.abs(np.array([space.low, space.high], np.float64)).max(initial=0.0) > LARGEST:
        raise ValueError(
            f"environment: the action space's bounds must be within +-{LARGEST:g}, got {space}; "
            "declare the range that the environment uses, since the policy's actions fill it"
        )
    return space


def to_bounds(actions: NDArray[np.float32], space: spaces.Box) -> NDArray[Any]:
    """Scale actions [B, A] from [-1, 1] to the bounds and the type of `check_action_space`."""
    # The difference of two float16 bounds may overflow float16.
    wide = np.result_type(space.low.dtype, np.float32)
    low, high = space.low.astype(wide, copy=False), space.high.astype(wide, copy=False)
    scaled = low + (actions + 1.0) * 0.5 * (high - low)
    return np.asarray(np.clip(scaled, low, high).astype(space.dtype))


# -- values -----------------------------------------------------------------------------------


def are_usable(values: NDArray[np.float32]) -> bool:
    """Whether a vector [N] is shorter than `LARGEST`, hence all its numbers finite and within it.

    It takes half a microsecond. If False, `check_numbers` finds the number, if there is one.
    """
    try:
        return bool(values.dot(values) < LARGEST**2)  # False for NaN
    except RuntimeWarning:  # an overflow, if warnings are errors
        return False


def check_numbers(name: str, values: Any) -> None:
    """Raise ValueError for the first number of an array [N], or a number, beyond `LARGEST`."""
    flat = np.atleast_1d(np.asarray(values, np.float64))
    bad = np.flatnonzero(~(np.abs(flat) <= LARGEST))
    if len(bad):
        entry = f"{name}[{bad[0]}]" if np.ndim(values) else name
        raise ValueError(
            f"{entry} is {flat[bad[0]]:g}, every number must be finite and within +-{LARGEST:g}"
        )


def shown(value: object) -> str:
    """A value of an environment on one line of at most 60 characters."""
    try:
        return shorten(" ".join(repr(value).split()), 60)
    except Exception:  # a class of the environment
        return f"an object of type {type(value).__name__}"


def vector(value: Any, name: str, size: int) -> NDArray[Any]:
    """The vector [size] of numbers that an environment returned as `name`."""
    try:
        array = np.asarray(value)
    except Exception:
        array = np.empty(0, object)
    if array.shape != (size,) or array.dtype.kind not in "fiub":
        raise ValueError(
            f"{name} must have shape ({size},), as its space declares, and hold numbers, "
            f"got {shown(value)} of shape {np.shape(array)} and type {array.dtype}"
        )
    return array


def number_of(value: Any, name: str) -> float:
    """The number that an environment returned as `name`."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f")  # a tensor's type has no kind
    if isinstance(value, float | int) or (getattr(value, "ndim", None) == 0 and kind in "fiub"):
        try:
            return float(value)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name} must be a number, got {shown(value)}")


def flag_of(value: Any, name: str) -> bool:
    """The bool, or the number 0 or 1, that an environment returned as `name`.

    `bool()` would accept the text "False", a distance and NaN as True.
    """
    if value is True or value is False:
        return value
    if isinstance(value, int | float | np.generic | np.ndarray) and np.ndim(value) == 0:
        array = np.asarray(value)
        if array.dtype.kind in "fiub" and array in (0, 1):
            return bool(array)
    raise ValueError(f"{name} must be a bool, or the number 0 or 1, got {shown(value)}")


def success_of(info: Mapping[str, Any], key: str | None, missing: bool | None) -> bool | None:
    """Whether `info` reports success; `missing` if it lacks the key, None if `key` is None."""
    if key is None:
        return None
    return flag_of(info[key], f"info[{key!r}]") if key in info else missing
