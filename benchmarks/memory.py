"""Peak memory of one trial with a million transitions, in a process of its own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measure import Row, start_ray

__all__ = ["rows"]

TRANSITIONS = 1_000_000
LIMIT = 1.2


def rows(repeats: int) -> Iterator[Row]:
    """Peak resident memory: Ray's client, torch, networks, replay, a checkpoint."""
    peak = statistics.median(peak_gigabytes() for _ in range(repeats))
    yield Row(
        "memory", f"one trial, {TRANSITIONS:,} transitions", peak, "GB",
        target=f"<= {LIMIT:g}", met=peak <= LIMIT,
    )  # fmt: skip


def peak_gigabytes() -> float:
    """Row of a trial's process, which reports its own memory."""
    finished = subprocess.run(
        [sys.executable, "-m", "benchmarks.memory"],
        stdout=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=True,
    )
    peak: float = json.loads(finished.stdout.splitlines()[-1])["peak_gb"]
    return peak


def main() -> None:
    """Train with a full replay for a while, save, and print the peak of resident memory."""
    from tempfile import TemporaryDirectory

    from benchmarks.checkpoint import save
    from benchmarks.runs import fill, settings
    from music_rllib.runtime.quiet import quiet_third_parties
    from music_rllib.store.node_store import NodeStore
    from music_rllib.training.run import TrainingRun

    quiet_third_parties()
    start_ray(1)
    training = TrainingRun(settings())
    fill(training.algorithm.replay, TRANSITIONS)
    training.advance()  # evaluates the untrained policy
    training.advance()
    assert training.algorithm.grad_updates > 0
    with TemporaryDirectory() as folder:
        save(training, NodeStore(folder).work_folder("0" * 20), Path(folder), 1)
    # Not `ru_maxrss`, which starts at the peak of the parent process.
    status = Path("/proc/self/status").read_text()
    peak = int(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e9
    print(json.dumps({"peak_gb": peak}))


if __name__ == "__main__":
    main()
