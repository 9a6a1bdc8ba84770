"""Checks of the numbers that an environment returns, since a NaN spreads to every weight."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST = 1e15
"""Largest accepted number: returns are up to a hundred times as large, and their squared errors,
summed over a minibatch, must stay within float32's range."""
_RULE = f"every number must be finite and within +-{LARGEST:g}"


class BadNumberError(RuntimeError):
    """An environment or a policy returned NaN, infinity or a huge number; says where."""


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
            raise BadNumberError(
                f"{where}: {entry} is {flat[bad[0]]:g}, {_RULE}\n"
                "The run stops before anything is learned from it; its last checkpoint is good."
            )
