"""A ring buffer of trajectories in one float32 array, and its trajectories in files.

A row is a frame (observation, desired goal, achieved goal), the action taken there, its reward, and
whether it was terminal; a transition is two neighboring rows, one stretch of memory. A trajectory
of n steps takes n + 1 rows and is never split by the ring's end, so a ring of capacity C holds
exactly C transitions of full episodes, fewer if episodes end early.

Memory, with h steps of the longest episode: ``4 (D + 2G + A + 2) bytes * C (h + 1)/h`` plus 16
bytes a trajectory, claimed from the system as it fills. A million FetchPush transitions: 151 MB.

Shape legend: N trajectories, n steps of one, D observation, G goal, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.replay.sampling import ranges
from music_rllib.replay.trajectories import Floats, ReplayLayout, Rows, Trajectory

TRAJECTORIES_PER_SEGMENT = 2_000
"""Most trajectories in a segment: its file is built in memory, 15 MB for Fetch."""

Arrays = Mapping[str, NDArray[Any]]


class TrajectoryRing:
    """Holds the newest trajectories that fit into `capacity` transitions of full episodes."""

    def __init__(self, layout: ReplayLayout, capacity: int) -> None:
        if capacity < layout.horizon:
            raise ValueError(
                f"replay.capacity must hold an episode of {layout.horizon} steps, got {capacity}"
            )
        self.layout = layout
        ring = capacity // layout.horizon * (layout.horizon + 1)
        # Pages of zeros take no memory until they are written.
        self._steps = np.zeros((ring, layout.frame + layout.action + 2), np.float32)
        self._frames = self._steps[:, : layout.frame]
        self._actions = self._steps[:, layout.frame : -2]
        self._rewards, self._terminal = self._steps[:, -2], self._steps[:, -1]
        self._starts = np.zeros(0, np.int64)
        self._lengths = np.zeros(0, np.int64)
        self._write = 0
        self._used = 0
        self.trajectories_added = 0

    @property
    def trajectories(self) -> int:
        return len(self._lengths)

    @property
    def nbytes(self) -> int:
        """Bytes of the full ring."""
        return self._steps.nbytes

    @property
    def used_nbytes(self) -> int:
        """Bytes of the ring that hold trajectories."""
        return self._used * self._steps.shape[1] * self._steps.itemsize

    def _store(self, trajectory: Trajectory) -> int:
        """Write a trajectory in place of the oldest ones, and return its first row."""
        steps = len(trajectory)
        if not 0 < steps <= self.layout.horizon:
            raise ValueError(f"an episode must have 1 to {self.layout.horizon} steps, got {steps}")
        start = self._make_room(steps + 1)
        end = start + steps
        self._frames[start : end + 1] = trajectory.frames
        self._actions[start:end] = trajectory.actions
        self._rewards[start:end] = trajectory.rewards
        self._terminal[start : end + 1] = 0.0
        self._terminal[end - 1] = trajectory.terminated
        self._starts = np.append(self._starts, start)
        self._lengths = np.append(self._lengths, steps)
        self._write = end + 1
        self._used = max(self._used, self._write)
        self.trajectories_added += 1
        return start

    def _make_room(self, frames: int) -> int:
        """Drop the oldest trajectories in the way of `frames` rows, and return the first row."""
        stale, held = 0, len(self._starts)
        if self._write + frames > len(self._frames):
            # The trajectories between here and the ring's end are the oldest: the ring wraps.
            while stale < held and self._starts[stale] >= self._write:
                stale += 1
            self._write = 0
        end = self._write + frames
        while stale < held and self._write <= self._starts[stale] < end:
            stale += 1
        self._drop(stale)
        return self._write

    def _drop(self, count: int) -> None:
        """Drop the `count` oldest trajectories."""
        self._starts, self._lengths = self._starts[count:], self._lengths[count:]

    def _read(self, rows: Rows, first: int, count: int) -> Floats:
        """Copy `count` numbers of `rows` [...] from column `first`, reaching into the next row.

        Returns [..., count]. Each stretch is copied as a whole, not number by number.
        """
        stretch, stride = np.dtype((np.void, 4 * count)), self._steps.strides[0]
        fitting = (self._steps.nbytes - 4 * (first + count)) // stride + 1
        stretches = np.ndarray((fitting,), stretch, self._steps.data, 4 * first, (stride,))
        return stretches[rows].view(np.float32).reshape(*rows.shape, count)

    @property
    def oldest(self) -> int:
        """Number of the oldest trajectory held; trajectories are numbered from 0 as added."""
        return self.trajectories_added - self.trajectories

    def packed(self, first: int, end: int | None = None) -> dict[str, NDArray[Any]]:
        """Copy the trajectories number `first` (>= `oldest`) to `end` - 1, concatenated.

        Returns:
            lengths [N], terminated [N], frames [sum of n+1, D + 2G], actions [sum of n, A],
            rewards [sum of n]; together with `index()` the whole state.
        """
        held = slice(first - self.oldest, None if end is None else end - self.oldest)
        starts, lengths = self._starts[held], self._lengths[held]
        steps = ranges(starts, lengths)
        return {
            "lengths": lengths.copy(),
            "terminated": self._terminal[starts + lengths - 1] > 0,
            "frames": self._frames[ranges(starts, lengths + 1)],
            "actions": self._actions[steps],
            "rewards": self._rewards[steps],
        }

    def _place(self, first: int, arrays: Mapping[str, NDArray[Any]]) -> int:
        """Write those of the trajectories `first`, ... that are in the index to their rows.

        Returns the number after the last one written.
        """
        lengths = np.asarray(arrays["lengths"], np.int64)
        begin, end = max(first, self.oldest), min(first + len(lengths), self.trajectories_added)
        if begin >= end:
            return begin
        given = slice(begin - first, end - first)
        held = slice(begin - self.oldest, end - self.oldest)
        starts, own = self._starts[held], self._lengths[held]
        frames, actions = arrays["frames"], arrays["actions"]
        if not np.array_equal(own, lengths[given]) or frames.shape[1] != self.layout.frame:
            raise ValueError(
                f"trajectories {begin} to {end - 1} must be those of the checkpoint's index, with "
                f"{self.layout.frame} numbers a frame, got {frames.shape[1]}"
            )
        # Steps before trajectory i in the arrays; each trajectory has one frame more than steps.
        before = np.cumsum(lengths) - lengths
        skipped, frames_skipped = before[given], (before + np.arange(len(lengths)))[given]
        rows, source = ranges(starts, own), ranges(skipped, own)
        self._frames[ranges(starts, own + 1)] = frames[ranges(frames_skipped, own + 1)]
        self._actions[rows] = actions[source]
        self._rewards[rows] = arrays["rewards"][source]
        self._terminal[starts + own - 1] = arrays["terminated"][given]
        return end


@dataclass(frozen=True)
class Segment:
    """A file with the trajectories number `first` to `end` - 1, written once."""

    name: str
    first: int
    end: int


def new_segments(
    replay: TrajectoryRing, stored: Sequence[Segment], write: Callable[[str, Arrays], str]
) -> list[Segment]:
    """Write the trajectories that are in none of the `stored` segments (oldest first).

    A stored trajectory never changes, so a checkpoint writes only those added since the last one.

    Args:
        replay: holds the trajectories.
        stored: segments of earlier checkpoints.
        write: takes a label and arrays, and returns the name of the segment.

    Returns:
        The segments that hold all of the replay, oldest first.
    """
    needed = [segment for segment in stored if segment.end > replay.oldest]
    first = max([replay.oldest, *(segment.end for segment in needed)])
    for begin in range(first, replay.trajectories_added, TRAJECTORIES_PER_SEGMENT):
        end = min(begin + TRAJECTORIES_PER_SEGMENT, replay.trajectories_added)
        name = write(f"{begin:09d}-{end:09d}", replay.packed(begin, end))
        needed.append(Segment(name, begin, end))
    return needed
