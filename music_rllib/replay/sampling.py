"""Uniform draws of transitions from trajectories that lie in a ring.

Shape legend: B transitions, N trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from music_rllib.replay.trajectories import Rows

__all__ = ["MOST_OF_ONE_EPISODE", "Places"]

MOST_OF_ONE_EPISODE = 0.4
"""Share of a minibatch that `hindsight_episodes: moved` may take from one episode, on average. Less
would last longer: with a tenth, until eight have moved, a run from scratch that was compared
learned FetchPush later (docs/results.md)."""


@dataclass(frozen=True)
class Places:
    """Where the transitions of some trajectories lie, to draw from."""

    starts: Rows
    lengths: Rows
    ends: Rows
    """[N] transitions up to the end of each trajectory."""
    longest: int
    """Transitions of the longest one; 0 if there is none."""
    equal: bool
    """Whether all are of one length."""

    @classmethod
    def of(cls, starts: Rows, lengths: Rows) -> Places:
        longest = int(lengths.max(initial=0))
        equal = len(lengths) > 0 and bool(lengths.min() == longest)
        return cls(starts, lengths, np.cumsum(lengths), longest, equal)

    @property
    def total(self) -> int:
        """Transitions of all."""
        return int(self.ends[-1]) if len(self.ends) else 0

    def draw(self, rng: np.random.Generator, count: int) -> tuple[Rows, Rows, Rows]:
        """First row, step and length of their trajectory, of `count` transitions; [B] each."""
        drawn = rng.integers(0, self.total, count)
        if self.equal:
            which, step = np.divmod(drawn, self.lengths[0])
        else:
            which = np.searchsorted(self.ends, drawn, side="right")
            step = drawn - (self.ends[which] - self.lengths[which])
        return self.starts[which], step, self.lengths[which]

    def few_of_one(self, rng: np.random.Generator, count: int, share: float) -> Rows:
        """Which of `count` transitions to draw from here, so that no trajectory gives too many.

        Args:
            share: of a minibatch, that these `count` make up.

        Returns:
            Positions: all, or as many as leave the longest trajectory `MOST_OF_ONE_EPISODE`.
        """
        of_longest = share * self.longest / self.total
        if of_longest <= MOST_OF_ONE_EPISODE:
            return np.arange(count)
        return np.flatnonzero(rng.random(count) < MOST_OF_ONE_EPISODE / of_longest)
