"""CPU time and memory of the driver of a sweep over many short runs, two at a time.

`RUNS=60 python -m benchmarks driver` takes fewer runs than 1,000.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
import ray
import yaml

from benchmarks.measure import Row

__all__ = ["rows"]

GROUP = "driver"
RUNS = int(os.environ.get("RUNS", "1000"))
ENV_STEPS = 200
LOOK_SECONDS = 0.5
MOST_SECONDS, MOST_MEGABYTES = 0.15, 400


def rows(_: int) -> Iterator[Row]:
    """One sweep, independent of the number of repeats."""
    ray.shutdown()  # the sweep starts its own
    document = {
        "name": "many",
        "tasks": ["FetchReach"],
        "seeds": list(range(RUNS)),
        "resources": {"num_cpus": 2, "cpus_per_run": 1},
        "defaults": {
            "env_steps": ENV_STEPS,
            "evaluation": {"interval": ENV_STEPS, "episodes": 1},
            "tac": {"hidden_sizes": [64, 64], "random_steps": 100, "replay_ratio": 0.5},
        },
        "stages": [{"name": "train", "variant": "tac"}],
    }
    with TemporaryDirectory() as folder:
        file = Path(folder, "many.yaml")
        file.write_text(yaml.safe_dump(document | {"storage": f"{folder}/results"}))
        seconds, megabytes = _driver_of(file, Path(folder, "results", "many", "state.json"))
    what = f"{RUNS:,} runs of {ENV_STEPS} steps"
    yield Row(GROUP, f"{what}: CPU time of the driver, a run", seconds, "s",
              target=f"<= {MOST_SECONDS}", met=seconds <= MOST_SECONDS)  # fmt: skip
    yield Row(GROUP, f"{what}: largest memory of the driver", megabytes, "MB",
              target=f"<= {MOST_MEGABYTES}", met=megabytes <= MOST_MEGABYTES)  # fmt: skip


def _driver_of(file: Path, state: Path) -> tuple[float, float]:
    """CPU seconds for each run after the first one, and megabytes, of the process itself."""
    command = [sys.executable, "-m", "music_rllib.sweep", "run", str(file)]
    environment = os.environ | {"MUSIC_RLLIB_REPORT": "off"}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    driver, begun, used, largest = psutil.Process(process.pid), None, 0.0, 0
    while process.poll() is None:
        with contextlib.suppress(psutil.Error, OSError, ValueError):
            times = driver.cpu_times()
            used, largest = times.user + times.system, max(largest, driver.memory_info().rss)
            if begun is None and (done := _finished(state)):
                begun = (done, used)
        time.sleep(LOOK_SECONDS)
    if process.returncode or begun is None:
        raise RuntimeError(f"the sweep ended with exit code {process.returncode}")
    done, before = begun
    return (used - before) / max(RUNS - done, 1), largest / 2**20


def _finished(state: Path) -> int:
    return sum(
        stage["runs"].get("finished", 0) for stage in json.loads(state.read_text())["stages"]
    )
