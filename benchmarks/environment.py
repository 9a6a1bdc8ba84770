"""Environment steps through our runner, against Gymnasium's own loop and the physics alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np

from benchmarks.measure import Row, compared, interleaved, middle, ratio_row
from music_rllib import TACConfig
from music_rllib.envs.make import make_env
from music_rllib.tac.env_runner import TrajectoryEnvRunner

__all__ = ["rows"]

GROUP = "environment"
ENV_ID, HORIZON = "FetchPush-v4", 50


def runner(count: int) -> TrajectoryEnvRunner:
    """A runner of `count` sub-environments with a fresh policy."""
    config = TACConfig().environment(ENV_ID).env_runners(num_envs_per_env_runner=count)
    config.debugging(seed=0)
    config.success_key = "is_success"
    return TrajectoryEnvRunner(config=config)


def stock_loop() -> Callable[[], None]:
    """An episode of the environment as Gymnasium makes it, with random actions."""
    make_env(ENV_ID).close()  # registers the robotics tasks
    env = gym.make(ENV_ID)
    actions = np.random.default_rng(0).uniform(-1, 1, (HORIZON, 4)).astype(np.float32)

    def turn() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    return turn


class Physics:
    """Replaces `mj_step` and measures the time in it."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._step: Callable[..., None] = mujoco.mj_step

    def __call__(self, *arguments: Any, **options: Any) -> None:
        begin = time.perf_counter()
        self._step(*arguments, **options)
        self.seconds += time.perf_counter() - begin


def share_of_physics(played: TrajectoryEnvRunner) -> float:
    """Share of the time of a call to `sample` that `mj_step` takes: throughput relative to it."""
    physics = Physics()
    with mock.patch.object(mujoco, "mj_step", physics):
        begin = time.perf_counter()
        played.sample()
        return physics.seconds / (time.perf_counter() - begin)


def rows(repeats: int) -> Iterator[Row]:
    """Rows for 1, 4, 8 and 16 sub-environments."""
    repeats *= 3  # a turn is short
    stock = stock_loop()
    for count in (1, 4, 8, 16):
        played = runner(count)
        taken = interleaved({"ours": played.sample, "stock": stock}, repeats)
        steps = count * HORIZON
        rate, cpu_rate = (steps / seconds for seconds in middle(taken["ours"]))
        what = f"{count} sub-environment" + ("s" if count > 1 else "")
        yield ratio_row(
            GROUP, what, rate, "steps/s", cpu=cpu_rate, against="gymnasium loop (speed)",
            **compared(taken["stock"], taken["ours"], factor=steps / HORIZON),
        )  # fmt: skip
        shares = [share_of_physics(played) for _ in range(repeats)]
        yield ratio_row(
            GROUP, what, rate, "steps/s", cpu=cpu_rate, against="mj_step alone (speed)",
            ratios=shares, at_least=0.85 if count == 8 else None,
        )  # fmt: skip
        played.stop()
