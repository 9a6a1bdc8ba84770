"""What a run takes: one trains for some seconds in a process of its own, as a sweep's runs do."""

from __future__ import annotations

import time
from typing import NamedTuple

import psutil
import ray
from ray.exceptions import RayTaskError

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Resources
from music_rllib.training.run import TrainingRun

__all__ = ["RunSample", "sample_run"]

SECONDS = 4.0
"""So long a run is trained at least, after a round that warms up."""


class RunSample(NamedTuple):
    """Measured of one run."""

    start_seconds: float
    """From asking for a process to its first environment steps."""
    steps_per_second: float
    """Environment steps, while it learns."""
    evaluation_seconds: float
    """Of one evaluation."""
    memory: int
    """Bytes that are its own at its end, the replay filled; libraries are shared among runs."""


def sample_run(run: RunSettings, resources: Resources) -> RunSample:
    """Trains a run for some seconds in a worker of the Ray that is connected.

    Raises:
        ValueError: settings that do not fit the environment.
    """
    bundle = resources.bundle
    options = {"num_cpus": bundle["CPU"], "num_gpus": bundle.get("GPU", 0.0)}
    began = time.perf_counter()
    worker = ray.remote(_Worker).options(**options, memory=bundle.get("memory")).remote()
    try:
        ray.get(worker.start.remote(run, resources.gpus_per_run))
        started = time.perf_counter() - began
        return RunSample(started, *ray.get(worker.train.remote()))
    except RayTaskError as error:
        raise error.cause from None
    finally:
        ray.kill(worker)


class _Worker:
    """A run in a process."""

    def start(self, run: RunSettings, gpus: float) -> None:
        """Until its first environment steps."""
        # Steps that teach nothing are many times cheaper than the others, and soon over.
        tac = run.tac.model_copy(update={"random_steps": 0})
        self._training = TrainingRun(run.model_copy(update={"tac": tac}), gpus=gpus)
        self._training.algorithm.env_runner.sample(num_episodes=1)

    def train(self) -> tuple[float, float, int]:
        """Steps a second, seconds of an evaluation, and bytes."""
        training = self._training
        training.algorithm.train()
        first, began = training.env_steps, time.perf_counter()
        while (elapsed := time.perf_counter() - began) < SECONDS:
            training.algorithm.train()
        steps, began = training.env_steps - first, time.perf_counter()
        training.evaluate()
        return steps / elapsed, time.perf_counter() - began, self._memory()

    def _memory(self) -> int:
        run, replay = self._training.run, self._training.algorithm.replay
        to_come = min(run.replay.capacity, run.env_steps) - len(replay)
        grows = replay.nbytes * max(to_come, 0) / run.replay.capacity
        return int(psutil.Process().memory_full_info().uss + grows)
