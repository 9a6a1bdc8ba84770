"""A search of many tiny trials: are the driver's memory and time per trial constant?

`python -m benchmarks.search 600` runs 600 trials.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import psutil
import ray
import yaml

from benchmarks.measure import Row, ratio_row

__all__ = ["rows"]

GROUP = "search"
TRIALS, SETTLED, AT_A_TIME = 200, 40, 2
"""Number of trials after which the driver has imported and cached everything."""
FLAT = 1.1
LOOK_SECONDS = 1.0
DOCUMENT: dict[str, Any] = {
    "name": "search",
    "tasks": ["Pendulum"],
    "seeds": [0],
    "resources": {"num_cpus": AT_A_TIME},
    "environments": {"Pendulum": {"env_id": "Pendulum-v1", "horizon": 200, "success_key": None}},
    "defaults": {
        "env_steps": 600,
        "num_envs": 2,
        "evaluation": {"interval": 300, "episodes": 1},
        "tac": {"random_steps": 200, "hidden_sizes": [16], "batch_size": 16, "replay_ratio": 0.2},
    },
    "stages": [
        {
            "name": "train",
            "variant": "tac",
            "search": {
                "space": {
                    "tac.entropic_index": {"float": [1.0, 2.5]},
                    "tac.alpha": {"float": [0.01, 0.5], "log": True},
                },
                "objective": {"metric": "evaluation/episode_return", "aggregate": "mean"},
                "final": None,
            },
        }
    ],
}


class Look(NamedTuple):
    """Resources that a driver has used after this number of completed trials."""

    trials: int
    seconds: float
    cpu_seconds: float
    memory_mb: float


def rows(repeats: int, trials: int = TRIALS) -> Iterator[Row]:
    """Rows of one round; 200 trials take about seven minutes."""
    del repeats
    ray.shutdown()  # the sweep starts its own
    looks = watched_search(trials)
    # After the last trial, seen slightly later in the state, it computes importances and the
    # report.
    searching = [look for look in looks if SETTLED <= look.trials < trials - 2 * AT_A_TIME]
    begin, end = searching[0], searching[-1]
    passed = end.trials - begin.trials
    yield ratio_row(
        GROUP, f"driver's memory after {end.trials} trials", end.memory_mb, "MB",
        against=f"after {begin.trials} trials", ratios=[end.memory_mb / begin.memory_mb],
        at_most=FLAT,
    )  # fmt: skip
    growth, _ = statistics.linear_regression(
        [look.trials for look in searching], [look.memory_mb for look in searching]
    )
    yield Row(GROUP, "its growth, a trial", growth, "MB")
    most = max(look.memory_mb for look in looks)
    yield Row(GROUP, "its largest, with the analyses at the end", most, "MB")
    yield Row(GROUP, "driver's CPU, a trial", (end.cpu_seconds - begin.cpu_seconds) / passed, "s")
    middle = min(searching, key=lambda look: abs(look.trials - (begin.trials + end.trials) / 2))
    early = (middle.seconds - begin.seconds) / (middle.trials - begin.trials)
    late = (end.seconds - middle.seconds) / (end.trials - middle.trials)
    yield ratio_row(
        GROUP, f"wall time a trial, {AT_A_TIME} at a time", late, "s",
        against="the first half's", ratios=[late / early], at_most=FLAT,
    )  # fmt: skip


def watched_search(trials: int) -> list[Look]:
    """Measure the driver of a whole search from another process."""
    document = copy.deepcopy(DOCUMENT)
    document["stages"][0]["search"]["trials"] = trials
    with TemporaryDirectory() as folder:
        file = Path(folder, "search.yaml")
        file.write_text(yaml.safe_dump(document | {"storage": f"{folder}/results"}))
        state = Path(folder, "results", DOCUMENT["name"], "state.json")
        command = [sys.executable, "-m", "music_rllib.sweep", str(file)]
        driver = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        looks: list[Look] = []
        begin = time.monotonic()
        try:
            while driver.poll() is None:
                with contextlib.suppress(psutil.Error):  # it has just ended
                    looks += _look(psutil.Process(driver.pid), state, begin)
                time.sleep(LOOK_SECONDS)
        finally:
            driver.terminate()
            driver.wait()
    if driver.returncode:
        raise RuntimeError(f"the search ended with {driver.returncode}")
    return looks


def _look(driver: psutil.Process, state: Path, begin: float) -> list[Look]:
    if not state.exists():
        return []
    (search,) = json.loads(state.read_text())["searches"] or [None]
    if search is None:
        return []
    used, cpu = driver.memory_info().rss / 1e6, driver.cpu_times()
    judged = search["arms"][0]["judged"]
    return [Look(judged, time.monotonic() - begin, cpu.user + cpu.system, used)]


def main() -> None:
    """Print the rows of a search with the given number of trials."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.search", description=__doc__)
    parser.add_argument("trials", nargs="?", type=int, default=TRIALS, help=f"default {TRIALS}")
    trials = parser.parse_args().trials
    if trials < 2 * SETTLED:
        parser.error(f"trials must be >= {2 * SETTLED}, got {trials}")
    for row in rows(1, trials):
        print(row)


if __name__ == "__main__":
    main()
