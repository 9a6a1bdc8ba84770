"""Measure the time and memory of a run on copies that train side by side for some seconds."""

from __future__ import annotations

import time
from statistics import fmean
from typing import Any, NamedTuple

import psutil
import ray
from ray.exceptions import RayError, RayTaskError

from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Resources
from music_rllib.errors import BadInputError, first_line
from music_rllib.training.failure_reason import in_words_only
from music_rllib.training.run import TrainingRun

SECONDS = 4.0
"""Minimum duration of the measured training, after one iteration of warm-up."""
PATIENCE = 60.0
"""Maximum wait for further processes after the first, if others use the cluster."""


class RunSample(NamedTuple):
    """Means over runs that trained at the same time."""

    start_seconds: float
    """Time from the request for processes until all have made their first environment steps."""
    steps_per_second: float
    """Environment steps per second of training."""
    evaluation_seconds: float
    """Duration of one evaluation."""
    memory: int
    """Bytes of the largest process at the end of its run, without libraries that runs share."""


def sample_run(run: RunSettings, resources: Resources, at_once: int) -> RunSample:
    """Train `at_once` copies of a run for some seconds, in workers of the connected Ray.

    Like the runs of a sweep, they share the caches, memory and clock speed of their machine. Copies
    that Ray cannot place are left out.

    Raises:
        BadInputError: A run fails.
    """
    bundle = resources.bundle
    options = {"num_cpus": bundle["CPU"], "num_gpus": bundle.get("GPU", 0.0)}
    began = time.perf_counter()
    workers: list[Any] = [
        ray.remote(_Worker).options(**options, memory=bundle.get("memory")).remote()
        for _ in range(at_once)
    ]
    try:
        starts = {worker.start.remote(run, resources.gpus_per_run): worker for worker in workers}
        ray.wait(list(starts))
        ready, _ = ray.wait(list(starts), num_returns=at_once, timeout=PATIENCE)
        ray.get(ready)
        started = time.perf_counter() - began
        found = ray.get([starts[one].train.remote() for one in ready])
        speeds, evaluations, memory = zip(*found, strict=True)
        return RunSample(started, fmean(speeds), fmean(evaluations), max(memory))
    except RayTaskError as error:
        raise error.cause from None
    except RayError as error:  # its process has died
        raise BadInputError(f"a run must be trained to be measured: {first_line(error)}") from error
    finally:
        for worker in workers:
            ray.kill(worker)


class _Worker:
    """Ray actor that trains a run."""

    def start(self, run: RunSettings, gpus: float) -> None:
        """Build the run and make its first environment steps."""
        # Leave out the initial steps without updates, which are many times faster.
        tac = run.tac.model_copy(update={"random_steps": 0, "warmup_steps": None})
        with in_words_only():
            self._training = TrainingRun(run.model_copy(update={"tac": tac}), gpus=gpus)
            self._training.algorithm.env_runner.sample(num_episodes=1)

    def train(self) -> tuple[float, float, int]:
        """Steps per second, seconds of an evaluation, and bytes of memory."""
        with in_words_only():
            return self._measure()

    def _measure(self) -> tuple[float, float, int]:
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
