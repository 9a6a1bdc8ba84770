"""A replay in files that are written once: segments of consecutive trajectories.

A trajectory never changes once it is stored, so a checkpoint writes only those that were added
since the last checkpoint, and names the segments that hold the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from music_rllib.replay.buffer import TrajectoryReplay

MOST = 2_000
"""Largest number of trajectories in a segment: a file is built in memory, 15 MB for Fetch."""

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Segment:
    """A file with the trajectories number `first` to `end` - 1."""

    name: str
    first: int
    end: int


def new_segments(
    replay: TrajectoryReplay, stored: Sequence[Segment], write: Callable[[str, Arrays], str]
) -> list[Segment]:
    """Writes the trajectories that none of the `stored` segments (oldest first) has.

    `write` takes a label and arrays and returns the name of the segment. Returns the segments that
    hold all of the replay, oldest first.
    """
    needed = [segment for segment in stored if segment.end > replay.oldest]
    first = max([replay.oldest, *(segment.end for segment in needed)])
    for begin in range(first, replay.trajectories_added, MOST):
        end = min(begin + MOST, replay.trajectories_added)
        name = write(f"{begin:09d}-{end:09d}", replay.packed(begin, end))
        needed.append(Segment(name, begin, end))
    return needed
