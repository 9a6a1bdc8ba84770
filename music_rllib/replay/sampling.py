"""Draws of transitions: uniform, by rank of trajectories (MUSIC-p), by TD error (PER).

Shape legend: B draws, N trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.replay.trajectories import Floats, Rows

Weights = NDArray[np.float64]

LARGEST_SHARE = 0.4
"""Largest mean share of a minibatch that `hindsight_episodes: moved` takes from one episode. A
smaller share has an effect for longer: a tenth, until eight episodes have moved. A run from scratch
then learned FetchPush later (docs/lab/appendix.md)."""
SMALLEST_ERROR = 1e-6
"""Added to every TD error, so that every transition can be drawn (Schaul et al. 2016, 3.3)."""


def ranges(starts: Rows, lengths: Rows) -> Rows:
    """[N], [N] -> [sum of lengths]: start, start + 1, ... of each, concatenated."""
    ends = np.cumsum(lengths)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(starts - (ends - lengths), lengths) + np.arange(total)


@dataclass(frozen=True)
class Places:
    """Rows of some trajectories in a ring, from which transitions are drawn uniformly."""

    starts: Rows
    lengths: Rows
    ends: Rows
    """[N] cumulative sum of the lengths."""
    longest: int
    """Length of the longest one; 0 if there is none."""
    equal: bool
    """Whether all have the same length."""

    @classmethod
    def of(cls, starts: Rows, lengths: Rows) -> Places:
        longest = int(lengths.max(initial=0))
        equal = len(lengths) > 0 and bool(lengths.min() == longest)
        return cls(starts, lengths, np.cumsum(lengths), longest, equal)

    @property
    def total(self) -> int:
        """Number of transitions."""
        return int(self.ends[-1]) if len(self.ends) else 0

    def draw(self, rng: np.random.Generator, count: int) -> tuple[Rows, Rows, Rows]:
        """Draw B transitions: first row of the trajectory, step in it, its length; [B] each."""
        drawn = rng.integers(0, self.total, count)
        if self.equal:
            which, step = np.divmod(drawn, self.lengths[0])
        else:
            which = np.searchsorted(self.ends, drawn, side="right")
            step = drawn - (self.ends[which] - self.lengths[which])
        return self.starts[which], step, self.lengths[which]

    def replaced(self, rng: np.random.Generator, count: int, share: float) -> Rows:
        """Which of `count` transitions, a `share` of a minibatch, to draw from these trajectories.

        All of them, or as many as `LARGEST_SHARE` of the longest trajectory allows.
        """
        of_longest = share * self.longest / self.total
        if of_longest <= LARGEST_SHARE:
            return np.arange(count)
        return np.flatnonzero(rng.random(count) < LARGEST_SHARE / of_longest)


def rank_weights(priorities: Weights) -> Weights:
    """[N] -> [N]: dense rank - 1, so that the least is never drawn (Zhao et al. 2021's code).

    If all priorities are equal, every weight is 1.
    """
    ranks = np.unique(priorities, return_inverse=True)[1].astype(np.float64)
    return ranks if ranks.any() else np.ones(len(priorities))


def draw_weighted(cumulative: Weights, uniform: Weights) -> Rows:
    """[N] cumulative weights, [B] numbers in [0, 1) -> [B] indices, in proportion to the weights.

    The largest index with a weight is the last result: rounding never leads beyond it.
    """
    drawn: Rows = np.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    last = int(np.searchsorted(cumulative, cumulative[-1]))
    return drawn.clip(max=last)


class SumTree:
    """Weights over 0..size-1 with vectorized updates and proportional draws in O(log size).

    A complete binary tree in one array: node i has children 2i and 2i + 1; leaves come last.
    """

    def __init__(self, size: int) -> None:
        self._leaves = 1 << max(size - 1, 1).bit_length()
        self._tree = np.zeros(2 * self._leaves, np.float64)

    @property
    def total(self) -> float:
        return float(self._tree[1])

    def __getitem__(self, indices: Rows) -> Weights:
        return self._tree[indices + self._leaves]

    def set(self, indices: Rows, weights: Weights | float) -> None:
        """Set weights >= 0; if an index occurs twice, its last weight counts."""
        nodes = np.asarray(indices, np.int64) + self._leaves
        self._tree[nodes] = weights
        while len(nodes) and nodes[0] > 1:
            nodes = np.unique(nodes >> 1)
            self._tree[nodes] = self._tree[2 * nodes] + self._tree[2 * nodes + 1]

    def draw(self, uniform: Weights) -> Rows:
        """[B] numbers in [0, 1) -> [B] indices, each with probability weight / total."""
        mass = uniform * self._tree[1]
        nodes = np.ones(len(mass), np.int64)
        while nodes[0] < self._leaves:
            nodes *= 2
            left = self._tree[nodes]
            # An empty right half is never entered, even if rounding would lead there.
            right = (mass >= left) & (self._tree[nodes + 1] > 0)
            mass = np.where(right, mass - left, mass)
            nodes += right
        return nodes - self._leaves


class TDPriorities:
    """Proportional prioritized replay over the rows of a ring of trajectories.

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
        """Add a trajectory that was stored in `steps` rows from `start` on."""
        rows = np.arange(start, start + steps)
        self._tree.set(rows, self._largest)
        self._start[rows], self._length[rows] = start, steps

    def remove(self, start: int, steps: int) -> None:
        """Remove the trajectory in these rows."""
        self._tree.set(np.arange(start, start + steps), 0.0)

    def draw(self, uniform: Weights) -> tuple[Rows, Rows, Rows]:
        """[B] numbers in [0, 1) -> trajectory's first row, step, and trajectory's length, [B]."""
        rows = self._tree.draw(uniform)
        start = self._start[rows].astype(np.int64)
        return start, rows - start, self._length[rows].astype(np.int64)

    def importance_weights(self, rows: Rows, transitions: int, exponent: float) -> Floats:
        """[B] (N P(i))^-beta, divided by the largest of them."""
        probability = self._tree[rows] / self._tree.total
        weights: Weights = (transitions * probability) ** -exponent
        scaled: Floats = (weights / weights.max()).astype(np.float32)
        return scaled

    def update(self, rows: Rows, errors: Floats) -> None:
        """Set the priorities of [B] rows by their absolute TD errors [B]."""
        priorities = (errors.astype(np.float64) + SMALLEST_ERROR) ** self._exponent
        self._tree.set(rows, priorities)
        self._largest = max(self._largest, float(priorities.max()))

    def packed(self, rows: Rows) -> dict[str, Any]:
        """The state for a checkpoint; `rows` are the rows of the trajectories held."""
        return {"leaves": self._tree[rows], "largest": self._largest}

    def load_packed(self, starts: Rows, lengths: Rows, state: dict[str, Any]) -> None:
        """Continue from the result of `packed` for these trajectories."""
        rows = ranges(starts, lengths)
        self._tree = SumTree(len(self._start))
        self._tree.set(rows, np.asarray(state["leaves"], np.float64))
        self._start[rows] = np.repeat(starts, lengths)
        self._length[rows] = np.repeat(lengths, lengths)
        self._largest = float(state["largest"])
