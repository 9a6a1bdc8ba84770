"""Sampling by priority: dense ranks of trajectories (MUSIC-p), TD errors of transitions (PER).

Shape legend: B draws, N trajectories.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]
Weights = NDArray[np.float64]

SMALLEST_ERROR = 1e-6
"""Added to every TD error, so that every transition can be drawn (Schaul et al. 2016, 3.3)."""
STEPS_FROM_GUIDE = 3
"""Sums that are compared one after the other before bisection."""


def ranges(starts: Indices, lengths: Indices) -> Indices:
    """[N], [N] -> [sum of lengths]: start, start + 1, ... of each, concatenated."""
    ends = np.cumsum(lengths)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(starts - (ends - lengths), lengths) + np.arange(total)


def rank_weights(priorities: Weights) -> Weights:
    """[N] -> [N]: dense rank - 1, so that the least is never drawn (Zhao et al. 2021's code).

    Where all are equal, every weight is 1.
    """
    ranks = np.unique(priorities, return_inverse=True)[1].astype(np.float64)
    return ranks if ranks.any() else np.ones(len(priorities))


class WeightedDraws:
    """Draws from N fixed weights in a time that hardly depends on N.

    A uniform number is looked up among the running sums of the weights. A guide table (Chen & Asau
    1974) says where to begin: the first sum beyond each of equal parts of the total. A few steps
    from there are nearly always enough; otherwise bisection finds the sum.

    Args:
        weights: [N] >= 0, not all 0.
    """

    def __init__(self, weights: Weights) -> None:
        self._indices = np.flatnonzero(weights)
        self._sums = np.cumsum(weights[self._indices])
        self._parts = 2 * len(self._indices)
        # One part too early: the product that finds a number's part may round up.
        edges = np.arange(-1, self._parts - 1) * (self._sums[-1] / self._parts)
        self._guide = np.searchsorted(self._sums, edges, side="right")

    def draw(self, uniform: Weights) -> Indices:
        """[B] numbers in [0, 1) -> [B] indices, each with probability weight / total."""
        mass = uniform * self._sums[-1]
        position = self._guide[(uniform * self._parts).astype(np.int64)]
        before = np.flatnonzero(self._sums[position] <= mass)
        for _ in range(STEPS_FROM_GUIDE):
            position[before] += 1
            before = before[self._sums[position[before]] <= mass[before]]
        position[before] = np.searchsorted(self._sums, mass[before], side="right")
        drawn: Indices = self._indices[position]
        return drawn


class SumTree:
    """Weights over 0..size-1 with vectorised updates and proportional draws in O(log size).

    A complete binary tree in one array: node i has children 2i and 2i + 1, leaves come last.
    """

    def __init__(self, size: int) -> None:
        self._leaves = 1 << max(size - 1, 1).bit_length()
        self._tree = np.zeros(2 * self._leaves, np.float64)

    @property
    def total(self) -> float:
        """Sum of all weights."""
        return float(self._tree[1])

    def __getitem__(self, indices: Indices) -> Weights:
        return self._tree[indices + self._leaves]

    def set(self, indices: Indices, weights: Weights | float) -> None:
        """Sets weights >= 0; where an index comes twice, its last weight counts."""
        nodes = np.asarray(indices, np.int64) + self._leaves
        self._tree[nodes] = weights
        while len(nodes) and nodes[0] > 1:
            nodes = np.unique(nodes >> 1)
            self._tree[nodes] = self._tree[2 * nodes] + self._tree[2 * nodes + 1]

    def draw(self, uniform: Weights) -> Indices:
        """[B] numbers in [0, 1) -> [B] indices, each with probability weight / total."""
        mass = uniform * self._tree[1]
        nodes = np.ones(len(mass), np.int64)
        while nodes[0] < self._leaves:
            nodes *= 2
            left = self._tree[nodes]
            # An empty right half is never entered, even where rounding would lead there.
            right = (mass >= left) & (self._tree[nodes + 1] > 0)
            mass = np.where(right, mass - left, mass)
            nodes += right
        return nodes - self._leaves


class TDPriorities:
    """Proportional prioritised replay over the rows of a ring of trajectories.

    Schaul et al. 2016, "Prioritized Experience Replay", section 3.3-3.4. New transitions get the
    largest priority so far.
    """

    def __init__(self, rows: int, exponent: float) -> None:
        self._tree = SumTree(rows)
        self._exponent = exponent
        self._largest = 1.0
        self._start = np.zeros(rows, np.int32)
        self._length = np.zeros(rows, np.int32)

    def add(self, start: int, steps: int) -> None:
        """Adds a trajectory that was stored in `steps` rows from `start` on."""
        rows = np.arange(start, start + steps)
        self._tree.set(rows, self._largest)
        self._start[rows], self._length[rows] = start, steps

    def remove(self, start: int, steps: int) -> None:
        """Removes the trajectory in these rows."""
        self._tree.set(np.arange(start, start + steps), 0.0)

    def draw(self, uniform: Weights) -> tuple[Indices, Indices, Indices]:
        """[B] numbers in [0, 1) -> trajectory's first row, step, and trajectory's length, [B]."""
        rows = self._tree.draw(uniform)
        start = self._start[rows].astype(np.int64)
        return start, rows - start, self._length[rows].astype(np.int64)

    def importance_weights(
        self, rows: Indices, transitions: int, exponent: float
    ) -> NDArray[np.float32]:
        """[B] (N P(i))^-beta, divided by the largest of them."""
        probability = self._tree[rows] / self._tree.total
        weights: Weights = (transitions * probability) ** -exponent
        scaled: NDArray[np.float32] = (weights / weights.max()).astype(np.float32)
        return scaled

    def update(self, rows: Indices, errors: NDArray[np.float32]) -> None:
        """Sets the priorities of [B] rows by their absolute TD errors [B]."""
        priorities = (errors.astype(np.float64) + SMALLEST_ERROR) ** self._exponent
        self._tree.set(rows, priorities)
        self._largest = max(self._largest, float(priorities.max()))

    def packed(self, rows: Indices) -> dict[str, Any]:
        """The state for a checkpoint; `rows` are those of the trajectories held."""
        return {"leaves": self._tree[rows], "largest": self._largest}

    def load_packed(self, starts: Indices, lengths: Indices, state: dict[str, Any]) -> None:
        """Continues where `packed` was taken of these trajectories."""
        rows = ranges(starts, lengths)
        self._tree = SumTree(len(self._start))
        self._tree.set(rows, np.asarray(state["leaves"], np.float64))
        self._start[rows] = np.repeat(starts, lengths)
        self._length[rows] = np.repeat(lengths, lengths)
        self._largest = float(state["largest"])
