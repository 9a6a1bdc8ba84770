"""A sweep of eight runs, two at a time, against the same runs without it; the start of a run."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import ray
import yaml

from benchmarks.measure import Row, ratio_row, start_ray, told_turns
from benchmarks.runs import settings

__all__ = ["rows"]

GROUP = "sweep"
RUNS, ENV_STEPS, AT_A_TIME = 8, 4_000, 2
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def rows(repeats: int) -> Iterator[Row]:
    """A round of the eight runs takes minutes, a round of the start seconds."""
    yield from start_up(repeats)
    ray.shutdown()  # the sweep starts its own
    rounds = [(sweep(), bare_runs(), bare_runs(one_ray=True)) for _ in told_turns(repeats)]
    wholes, bares, sharing = zip(*rounds, strict=True)
    what = f"{RUNS} runs of {ENV_STEPS:,} steps"
    yield ratio_row(
        GROUP, what, statistics.median(wholes), "s",
        against=f"the same runs bare, {AT_A_TIME} at a time (time)",
        ratios=[whole / bare for whole, bare in zip(wholes, bares, strict=True)], at_most=1.05,
    )  # fmt: skip
    added = [whole - bare for whole, bare in zip(wholes, sharing, strict=True)]
    yield ratio_row(
        GROUP, f"{what}: more than bare runs that share a Ray", statistics.median(added), "s",
        against="these (time of the whole)",
        ratios=[whole / bare for whole, bare in zip(wholes, sharing, strict=True)],
    )  # fmt: skip


def sweep() -> float:
    """Wall time of the whole program, including Ray and the MLflow store."""
    run = settings(ENV_STEPS)
    document = {
        "name": "bench",
        "tasks": ["FetchPush"],
        "seeds": list(range(RUNS)),
        "resources": {"num_cpus": AT_A_TIME, "cpus_per_run": 1},
        "defaults": {
            "env_steps": run.env_steps,
            "evaluation": run.evaluation.model_dump(mode="json"),
            "tac": {"replay_ratio": run.tac.replay_ratio, "random_steps": run.tac.random_steps},
            "replay": {"capacity": run.replay.capacity, "hindsight_k": run.replay.hindsight_k},
        },
        "stages": [{"name": "train", "variant": "tac"}],
    }
    with TemporaryDirectory() as folder:
        file = Path(folder, "bench.yaml")
        file.write_text(yaml.safe_dump(document | {"storage": f"{folder}/results"}))
        return _wall_time("-m", "music_rllib.sweep", str(file))


def bare_runs(*, one_ray: bool = False) -> float:
    """Wall time of the same number of plain processes, each of which only trains one run.

    RLlib starts a Ray in each process, unless all use `one_ray`, which is started before the clock.
    """
    address = []
    if one_ray:
        start_ray(AT_A_TIME)
        address.append(ray.get_runtime_context().gcs_address)

    def bare_run(seed: int) -> float:
        return _wall_time("-m", "benchmarks.sweep", str(seed), *address)

    begin = time.perf_counter()
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        list(pool.map(bare_run, range(RUNS)))
    taken = time.perf_counter() - begin
    ray.shutdown()
    return taken


def _wall_time(*arguments: str) -> float:
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, *arguments], env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=True
    )
    return time.perf_counter() - begin


class Starter:
    """Work of a trial's process until its first episode has been played."""

    def first_step(self) -> int:
        from music_rllib.training.run import TrainingRun

        training = TrainingRun(settings())
        training.algorithm.env_runner.sample(num_episodes=1)
        return os.getpid()


def start_up(repeats: int) -> Iterator[Row]:
    """Time from asking Ray for a process to the first environment steps."""
    actor = ray.remote(num_cpus=1)(Starter)
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        starter = actor.remote()
        ray.get(starter.first_step.remote())
        taken.append(time.perf_counter() - begin)
        ray.kill(starter)
    middle = statistics.median(taken)
    yield Row(GROUP, "start of a run to its first steps", middle, "s", target="<= 6",
              met=middle <= 6)  # fmt: skip


def train(seed: int, address: str = "local") -> None:
    """One run without a sweep, with the Ray at `address` or its own."""
    from music_rllib.runtime.quiet import quiet_third_parties
    from music_rllib.training.run import TrainingRun

    quiet_third_parties()
    start_ray(1, address)
    training = TrainingRun(settings(ENV_STEPS, seed))
    while not training.finished:
        training.advance()


if __name__ == "__main__":
    train(int(sys.argv[1]), *sys.argv[2:])
