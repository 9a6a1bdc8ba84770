"""Checks of the values that an environment returns, since a NaN spreads to every weight.

The functions without a `where` raise ValueError for a bad value; their callers know the environment
and the step, and add them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST = 1e15
"""Largest accepted number: returns are up to a hundred times as large, and their squared errors,
summed over a minibatch, must stay within float32's range."""
_RULE = f"every number must be finite and within +-{LARGEST:g}"


class BadNumberError(RuntimeError):
    """An environment or a policy returned a value that can't be learned from; says where."""

    @classmethod
    def at(cls, where: str, problem: object) -> BadNumberError:
        """The error of a `problem` with the values of an environment at the step `where`."""
        return cls(
            f"{where}: {problem}\n"
            "The run stops before anything is learned from it; its last checkpoint is good."
        )


def are_usable(values: NDArray[np.float32]) -> bool:
    """Whether the length of the vector [N] is below `LARGEST`; takes half a microsecond.

    If so, every number is finite and within `LARGEST`; if not, `check_numbers` checks each.
    """
    try:
        # NaN is not less than anything.
        return bool(values.dot(values) < LARGEST**2)
    except RuntimeWarning:  # of an overflow, where warnings are errors
        return False


def check_numbers(named: Iterable[tuple[str, Any]], where: str) -> None:
    """Raises BadNumberError for the first bad number among named arrays [N] or numbers.

    `where` names the environment and the step that returned them.
    """
    for name, values in named:
        flat = np.atleast_1d(np.asarray(values, np.float64))
        bad = np.flatnonzero(~(np.abs(flat) <= LARGEST))
        if len(bad):
            entry = f"{name}[{bad[0]}]" if np.ndim(values) else name
            raise BadNumberError.at(where, f"{entry} is {flat[bad[0]]:g}, {_RULE}")


def shown(value: object, limit: int = 60) -> str:
    """A value of an environment on one line of at most `limit` characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # an environment's own class may do anything
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= limit else text[: limit - 3] + "..."


def vector(value: Any, name: str, size: int) -> NDArray[Any]:
    """The vector [size] of numbers that an environment returned as `name`; else ValueError.

    NumPy would repeat a single number, and read numbers from texts.
    """
    if type(value) is np.ndarray and value.shape == (size,) and value.dtype.kind in "fiub":
        return value
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
    """The number that an environment returned as `name`; ValueError for anything else."""
    if isinstance(value, float | int | np.number | np.bool_) or (
        getattr(value, "ndim", None) == 0 and not isinstance(value, str)
    ):
        try:
            return float(value)
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{name} must be a number, got {shown(value)}")


def flag_of(value: Any, name: str) -> bool:
    """A bool, or 0 or 1 as a number or an array without dimensions; ValueError for others.

    `bool()` would take the text "False", a distance and NaN for true.
    """
    if value is True or value is False:
        return value
    if isinstance(value, int | float | np.generic | np.ndarray) and np.ndim(value) == 0:
        array = np.asarray(value)
        if array.dtype.kind in "fiub" and array in (0, 1):
            return bool(array)
    raise ValueError(f"{name} must be a bool, or the number 0 or 1, got {shown(value)}")


def success_of(info: Mapping[str, Any], key: str | None, missing: bool | None) -> bool | None:
    """Whether a step's `info` reports success under `key`.

    `missing` stands for a step without the key; None without a key. ValueError for other values.
    """
    if key is None:
        return None
    return flag_of(info[key], f"info[{key!r}]") if key in info else missing
