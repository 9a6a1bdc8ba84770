"""What an environment returns is looked at where it comes in: a NaN spreads to every weight."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["LARGEST", "BadNumberError", "are_usable", "bad_number"]

LARGEST = 1e15
"""Beyond it, squared errors of returns a hundred times as large, summed over a minibatch, leave
float32's range."""
_RULE = f"every number must be finite and within +-{LARGEST:g}"


class BadNumberError(RuntimeError):
    """NaN, infinity or an absurd number where nothing can be learned from it; says where."""


def are_usable(values: NDArray[np.float32]) -> bool:
    """Whether the numbers, [N], are surely finite and within `LARGEST`, in half a microsecond.

    Where they are not, `bad_number` finds out: the vector's length is what is looked at.
    """
    try:
        # NaN is not less than anything.
        return bool(values.dot(values) < LARGEST**2)
    except RuntimeWarning:  # of an overflow, where warnings are errors
        return False


def bad_number(named: Iterable[tuple[str, Any]], where: str) -> BadNumberError | None:
    """The error that names the first bad one among some arrays; None if there is none.

    Args:
        named: name and array [N], or number.
        where: who returned them and when.
    """
    for name, values in named:
        flat = np.atleast_1d(np.asarray(values, np.float64))
        bad = np.flatnonzero(~(np.abs(flat) <= LARGEST))
        if len(bad):
            entry = f"{name}[{bad[0]}]" if np.ndim(values) else name
            return BadNumberError(
                f"{where}: {entry} is {flat[bad[0]]:g}, {_RULE}\n"
                "The run stops before anything is learned from it; its last checkpoint is good."
            )
    return None
