"""The data of a replay: trajectories, transitions, and batches of whole trajectories.

Shape legend: B transitions, N trajectories, n steps of one, T frames of the longest one,
D observation, G goal, A action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SHORTEST = 2
"""Fewest steps of a trajectory that the estimator learns from: with two frames, half of all
permutations of time are the identity."""

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class ReplayLayout:
    """Sizes of what is stored."""

    observation: int
    action: int
    goal: int
    horizon: int
    """Steps of the longest episode."""

    @property
    def frame(self) -> int:
        return self.observation + 2 * self.goal

    @property
    def network_input(self) -> int:
        """Observation and desired goal: the first columns of a frame."""
        return self.observation + self.goal


@dataclass(frozen=True)
class Trajectory:
    """One finished episode of n steps."""

    frames: Floats
    """[n+1, D + 2G]: observation, desired goal, achieved goal."""
    actions: Floats
    """[n, A] in [-1, 1]."""
    rewards: Floats
    """[n] the environment's."""
    terminated: bool
    """Whether it ended in a terminal state; a truncated trajectory keeps its bootstrap."""

    def __len__(self) -> int:
        return len(self.actions)


@dataclass(frozen=True)
class Transitions:
    """One minibatch, or several concatenated."""

    inputs: Floats
    """[B, D + G] observation and desired goal."""
    actions: Floats
    """[B, A]"""
    rewards: Floats
    """[B] task reward, recomputed if the goal was relabeled; with n steps, their discounted sum."""
    discounts: Floats
    """[B] 0 if the episode terminated, 1 otherwise; with n steps, times gamma^(n - 1)."""
    next_inputs: Floats
    """[B, D + G]"""
    weights: Floats | None
    """[B] importance weights in (0, 1]; None if transitions are not drawn by TD error."""
    rows: Rows
    """[B] rows of the ring, for `update_priorities`."""


def long_enough(lengths: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[N] steps -> [N] whether the estimator learns from it; all True if all are too short."""
    return lengths >= min(SHORTEST, int(lengths.max(initial=0)))


@dataclass(frozen=True)
class WholeTrajectories:
    """Trajectories from their first to their last frame."""

    observations: Floats
    """[N, T, D]; a shorter one is padded with its last frame."""
    inside: NDArray[np.bool_] | None
    """[N, T] False for padding; None if all have the same length."""

    @classmethod
    def of(cls, frames: Sequence[Floats]) -> WholeTrajectories:
        """Stacks N arrays [n+1, D]."""
        counts = np.array([len(each) for each in frames])
        if (counts == counts[0]).all():
            return cls(np.stack(frames), None)
        longest = int(counts.max())
        padded = [np.pad(each, ((0, longest - len(each)), (0, 0)), mode="edge") for each in frames]
        return cls(np.stack(padded), np.arange(longest) < counts[:, None])
