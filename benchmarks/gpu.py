"""Updates on a GPU compared with compiled updates on one core, and runs that share a GPU."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from typing import Any

import torch

from benchmarks.measure import Row, compared, interleaved, middle, ratio_row, start_ray
from benchmarks.runs import settings
from benchmarks.training_step import UPDATES, algorithm, updates
from music_rllib.config.schema import Resources
from music_rllib.training.sample_run import sample_run

__all__ = ["rows"]

GROUP = "GPU"
ON_CPU = {(128, 256): 50, (256, 256): 50, (512, 512): 8, (512, 2048): 4, (1024, 2048): 2}
"""Width of the three layers, batch size, and updates per turn on a CPU."""
RUNS: dict[tuple[int, int], tuple[int, ...]] = {(256, 256): (1, 8), (512, 2048): (8,)}
"""Width, batch size, and numbers of simultaneous runs."""


def rows(repeats: int) -> Iterator[Row]:
    """Rows of the GPU; none if PyTorch does not find one."""
    if not torch.cuda.is_available():
        print("PyTorch sees no NVIDIA GPU: not measured", file=sys.stderr)
        return
    for (width, batch), count in ON_CPU.items():
        yield _updates(width, batch, count, repeats)
    import ray

    ray.shutdown()
    start_ray(os.cpu_count() or 1)
    for (width, batch), numbers in RUNS.items():
        for number in numbers:
            yield _whole_runs(width, batch, number)


def _updates(width: int, batch: int, count: int, repeats: int) -> Row:
    options: dict[str, Any] = {
        "hidden_sizes": (width,) * 3,
        "batch_size": batch,
        "hindsight_k": 4.0,
        "played": 400,
    }
    taken = interleaved(
        {
            "GPU": updates(algorithm(gpus=1.0, **options)),
            "CPU": updates(algorithm(**options), count),
        },
        repeats,
    )
    wall, cpu = middle(taken["GPU"])
    return ratio_row(
        GROUP, f"updates, 3 x {width}, batch {batch:,}", UPDATES / wall, "updates/s",
        cpu=UPDATES / cpu, against="compiled updates on one core (time)",
        **compared(taken["GPU"], taken["CPU"], count / UPDATES),
    )  # fmt: skip


def _whole_runs(width: int, batch: int, number: int) -> Row:
    run = settings()
    changed = {"hidden_sizes": (width,) * 3, "batch_size": batch}
    run = run.model_copy(update={"tac": run.tac.model_copy(update=changed)})
    on_gpu, on_cpu = (
        sample_run(run, Resources(gpus_per_run=gpus), number).steps_per_second
        for gpus in (1 / number, 0.0)
    )
    return ratio_row(
        GROUP, f"each of {number} runs, 3 x {width}, batch {batch:,}", on_gpu, "env steps/s",
        against=f"{number} runs on a core each (speed)", ratios=[on_gpu / on_cpu],
    )  # fmt: skip
