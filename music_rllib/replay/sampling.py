"""Uniform draws of transitions from trajectories that lie in a ring.

Shape legend: B transitions, N trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from music_rllib.replay.trajectories import Rows

MOST_OF_ONE_EPISODE = 0.4
"""Share of a minibatch that `hindsight_episodes: moved` may take from one episode, on average. A
smaller share stays in effect for longer: a tenth, until eight episodes have moved; a run from
scratch then learned FetchPush later (docs/lab/appendix.md)."""


@dataclass(frozen=True)
class Places:
    """The rows of some trajectories, from which transitions are drawn."""

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
        """Draws `count` transitions: first row of their trajectory, step, its length; [B] each."""
        drawn = rng.integers(0, self.total, count)
        if self.equal:
            which, step = np.divmod(drawn, self.lengths[0])
        else:
            which = np.searchsorted(self.ends, drawn, side="right")
            step = drawn - (self.ends[which] - self.lengths[which])
        return self.starts[which], step, self.lengths[which]

    def few_of_one(self, rng: np.random.Generator, count: int, share: float) -> Rows:
        """Those of `count` transitions, a `share` of a minibatch, to draw from these trajectories.

        All of them, or so few that `MOST_OF_ONE_EPISODE` holds for the longest trajectory.
        """
        of_longest = share * self.longest / self.total
        if of_longest <= MOST_OF_ONE_EPISODE:
            return np.arange(count)
        return np.flatnonzero(rng.random(count) < MOST_OF_ONE_EPISODE / of_longest)
