"""The time and memory that a run takes, measured on one that trains for some seconds."""

from __future__ import annotations

import time
from typing import NamedTuple

import psutil
import ray
from ray.exceptions import RayTaskError

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Resources
from music_rllib.training.run import TrainingRun

SECONDS = 4.0
"""Shortest duration of the measured training, after one iteration that warms up."""


class RunSample(NamedTuple):
    """Measurements of one run."""

    start_seconds: float
    """Time from the request for a process to its first environment steps."""
    steps_per_second: float
    """Environment steps per second of training."""
    evaluation_seconds: float
    """Duration of one evaluation."""
    memory: int
    """Bytes of the process at the run's end, without the libraries that all runs share."""


def sample_run(run: RunSettings, resources: Resources) -> RunSample:
    """Train a run for some seconds in a worker of the connected Ray.

    Raises:
        ValueError: The settings do not fit the environment.
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
    """Ray actor that trains the run."""

    def start(self, run: RunSettings, gpus: float) -> None:
        """Build the run and make its first environment steps."""
        # Random steps, without updates, are many times faster than the others, and soon over.
        tac = run.tac.model_copy(update={"random_steps": 0})
        self._training = TrainingRun(run.model_copy(update={"tac": tac}), gpus=gpus)
        self._training.algorithm.env_runner.sample(num_episodes=1)

    def train(self) -> tuple[float, float, int]:
        """The last three numbers of a `RunSample`."""
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
