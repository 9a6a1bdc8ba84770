"""Checkpoints with 100,000 and a million transitions: the first, the next, and coming back."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import Row
from benchmarks.runs import fill, settings
from music_rllib.experiment.store import NodeStore, WorkFolder
from music_rllib.experiment.training import TrainingRun

__all__ = ["rows"]

GROUP = "checkpoint"


def rows(repeats: int) -> Iterator[Row]:
    """Seconds and megabytes, on the disk of the temporary folder."""
    for transitions in (100_000, 1_000_000):
        training = TrainingRun(settings())
        with TemporaryDirectory() as folder:
            work = NodeStore(folder).work_folder("0" * 20)
            fill(training, transitions)
            yield from measured(training, work, Path(folder), transitions, repeats)
        training.close()


def measured(
    training: TrainingRun, work: WorkFolder, folder: Path, transitions: int, repeats: int
) -> Iterator[Row]:
    """The first checkpoint writes the whole replay, the others what 10,000 steps added."""
    what = f"{transitions:,} transitions"
    first, size = save(training, work, folder, 1)
    yield Row(GROUP, f"{what}: first save", first, "s")
    yield Row(GROUP, f"{what}: first save", size, "MB")
    later = []
    for i in range(repeats):
        fill(training, len(training.algorithm.replay))
        add(training, 200)
        later.append(save(training, work, folder, 2 + i))
    yield Row(GROUP, f"{what}: save 10,000 steps later", _median(later, 0), "s")
    yield Row(GROUP, f"{what}: save 10,000 steps later", _median(later, 1), "MB")
    restored = []
    for _ in range(repeats):
        other = TrainingRun(settings())
        begin = time.perf_counter()
        with work.newest() as saved:
            assert saved is not None
            other.restore(saved)
        restored.append(time.perf_counter() - begin)
        other.close()
    yield Row(GROUP, f"{what}: restore", statistics.median(restored), "s")


def add(training: TrainingRun, trajectories: int) -> None:
    """What 50 times as many environment steps would add."""
    import numpy as np

    from benchmarks.sampling import random_trajectory

    rng = np.random.default_rng(1)
    training.algorithm.replay.extend([random_trajectory(rng) for _ in range(trajectories)])


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


def _median(pairs: list[tuple[float, float]], index: int) -> float:
    return statistics.median(pair[index] for pair in pairs)
