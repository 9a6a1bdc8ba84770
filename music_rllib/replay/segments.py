"""A replay in files that are written once: segments of trajectories, in the order of their coming.

A trajectory never changes once it is stored, so a checkpoint writes those that have come since the
last one, and names the segments that hold the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from music_rllib.replay.buffer import TrajectoryReplay

__all__ = ["Segment", "load_segments", "new_segments"]

MOST = 2_000
"""Trajectories of a segment: a file is made in memory, some 15 MB for the Fetch tasks."""

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
    """Write what is new.

    Args:
        replay: What is to be saved.
        stored: Segments that are written already, oldest first.
        write: Takes a label and arrays, and gives the name under which it has written them.

    Returns:
        The segments that hold all of the replay, oldest first.
    """
    needed = [segment for segment in stored if segment.end > replay.oldest]
    first = max([replay.oldest, *(segment.end for segment in needed)])
    for begin in range(first, replay.trajectories_added, MOST):
        end = min(begin + MOST, replay.trajectories_added)
        name = write(f"{begin:09d}-{end:09d}", replay.packed(begin, end))
        needed.append(Segment(name, begin, end))
    return needed


def load_segments(
    replay: TrajectoryReplay,
    index: Mapping[str, Any],
    segments: Iterable[Segment],
    read: Callable[[str], Arrays],
) -> None:
    """Continue exactly where `index` (`replay.index()`) was taken; one segment in memory at a time.

    Raises:
        ValueError: They come from a replay of other sizes, or do not make up all of it.
    """
    replay.load_packed(dict(index), ((segment.first, read(segment.name)) for segment in segments))
