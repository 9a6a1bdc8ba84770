"""Whole trajectories of unequal lengths side by side, as the estimator learns from them.

Shape legend: N trajectories, T frames of the longest one, D observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["WholeTrajectories", "long_enough"]

SHORTEST = 2
"""Steps of a trajectory that time can be shuffled in: of two frames half of all permutations are
the identity."""

Floats = NDArray[np.float32]


def long_enough(lengths: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[N] steps -> [N] whether the estimator learns from it; all, where there are only short ones.

    Not less than the longest one has, so that there is always something to learn from.
    """
    return lengths >= min(SHORTEST, int(lengths.max(initial=0)))


@dataclass(frozen=True)
class WholeTrajectories:
    """Trajectories from their first to their last frame."""

    observations: Floats
    """[N, T, D]; behind a shorter one its last frame again."""
    inside: NDArray[np.bool_] | None
    """[N, T] False for what is behind a shorter one; None where all are of one length."""

    @classmethod
    def of(cls, frames: Sequence[Floats]) -> WholeTrajectories:
        """Of N arrays [n+1, D]."""
        counts = np.array([len(one) for one in frames])
        if (counts == counts[0]).all():
            return cls(np.stack(frames), None)
        longest = int(counts.max())
        padded = [np.pad(one, ((0, longest - len(one)), (0, 0)), mode="edge") for one in frames]
        return cls(np.stack(padded), np.arange(longest) < counts[:, None])
