"""Many short runs in a few worker processes, against a new process for each run."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from benchmarks.measure import Row, ratio_row
from music_rllib import load_sweep, names

__all__ = ["rows"]

GROUP = "warm"
VARIABLE = "BENCH_RUNS"
"""Environment variable with the number of runs, for a quick estimate from fewer."""
ENV_STEPS, AT_A_TIME = 1_200, 2
GROWTH = 1.05
"""Largest ratio of a worker's memory late in a sweep to its memory halfway."""
PROGRAM = """\
import sys
import music_rllib.tune.runner as runner
if sys.argv.pop(1) == "cold":
    runner._may_share_processes = lambda sweep: False
from music_rllib.program import main
sys.exit(main(["run", *sys.argv[1:]]))
"""


def rows(repeats: int) -> Iterator[Row]:
    """One round, independent of `repeats`: a round has many runs and takes minutes."""
    runs = int(os.environ.get(VARIABLE, "60"))
    cold, _ = sweep("cold", runs)
    warm, memory = sweep("warm", runs)
    yield ratio_row(
        GROUP, f"{runs} runs of {ENV_STEPS:,} steps", warm, "s",
        against="a new process for each run (time)", ratios=[warm / cold], at_most=0.5,
    )  # fmt: skip
    third = max(1, runs // 3)
    before, after = (statistics.median(part) for part in (memory[third:-third], memory[-third:]))
    yield ratio_row(
        GROUP, f"memory of a worker, last {third} runs", after, "MB",
        against="the runs before these, without the first ones (memory)", ratios=[after / before],
        at_most=GROWTH,
    )  # fmt: skip


def sweep(kind: str, runs: int) -> tuple[float, list[float]]:
    """Wall time of a whole sweep, and the memory in MB at the end of each run, in order."""
    with TemporaryDirectory() as folder:
        document = {
            "name": "bench",
            "storage": folder,
            "preset": "small",
            "tasks": ["FetchReach"],
            "seeds": list(range(runs)),
            "resources": {"num_cpus": AT_A_TIME},
            "defaults": {
                "env_steps": ENV_STEPS,
                "evaluation": {"interval": ENV_STEPS, "episodes": 4},
                "tac": {"replay_ratio": 0.4, "random_steps": 400},
            },
            "stages": [{"name": "train", "variant": "tac"}],
        }
        file = Path(folder, "bench.yaml")
        file.write_text(yaml.safe_dump(document))
        environment = os.environ | {names.VARIABLE_REPORT: "off"}
        command = [sys.executable, "-c", PROGRAM, kind, str(file)]
        begin = time.perf_counter()
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)
        seconds = time.perf_counter() - begin
        curves = load_sweep(Path(folder, "bench")).curves
        memory = curves[curves["metric"] == names.SYSTEM_MEMORY].sort_values("time")
        return seconds, memory.groupby("key", sort=False)["value"].last().to_list()
