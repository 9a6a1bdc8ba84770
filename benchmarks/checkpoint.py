"""Checkpoints with 100,000 and a million transitions: writing the first and the next, restoring."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.measure import Row, taken_by
from benchmarks.runs import fill, settings
from benchmarks.sampling import random_trajectory
from music_rllib.store.node_store import NodeStore
from music_rllib.store.work_folder import WorkFolder
from music_rllib.training.run import TrainingRun

__all__ = ["rows"]

GROUP = "checkpoint"
COLUMNS = (
    ("first save", "s"),
    ("first save", "MB"),
    ("save 10,000 steps later", "s"),
    ("save 10,000 steps later", "MB"),
    ("restore", "s"),
)


def rows(repeats: int) -> Iterator[Row]:
    """Seconds and megabytes, on the disk of the temporary folder."""
    for transitions in (100_000, 1_000_000):
        turns = [turn(transitions) for _ in range(repeats)]
        for (what, unit), values in zip(COLUMNS, zip(*turns, strict=True), strict=True):
            yield Row(
                GROUP, f"{transitions:,} transitions: {what}", statistics.median(values), unit
            )


def turn(transitions: int) -> tuple[float, ...]:
    """The first checkpoint writes the whole replay, the next one only the last 10,000 steps."""
    with TemporaryDirectory() as folder, closing(TrainingRun(settings())) as training:
        work = NodeStore(folder).work_folder("0" * 20)
        replay = training.algorithm.replay
        fill(replay, transitions)
        first = save(training, work, Path(folder), 1)
        rng = np.random.default_rng(1)
        replay.extend([random_trajectory(rng) for _ in range(200)])
        later = save(training, work, Path(folder), 2)
        with closing(TrainingRun(settings())) as other, work.newest() as saved:
            assert saved is not None
            restoring = taken_by(partial(other.restore, saved)).wall
    return *first, *later, restoring


def save(training: TrainingRun, work: WorkFolder, folder: Path, step: int) -> tuple[float, float]:
    """Seconds, and megabytes newly written."""
    before = _files(folder)
    begin = time.perf_counter()
    with work.new_checkpoint(step) as draft:
        training.save(draft)
    taken = time.perf_counter() - begin
    new = {path: size for path, size in _files(folder).items() if path not in before}
    return taken, sum(new.values()) / 1e6


def _files(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
