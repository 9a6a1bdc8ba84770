"""`kill -9` of remote environment runners, whose episodes are played again identically."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from ray import tune
from ray.rllib.callbacks.callbacks import RLlibCallback

from music_rllib import TACConfig
from music_rllib.tac.algorithm import TAC
from tests.integration.algorithm.test_tac_algorithm import build, fingerprint

pytestmark = pytest.mark.usefixtures("local_ray")


def remote_runner() -> TAC:
    return build(where={"num_env_runners": 1})


class Restarts(RLlibCallback):  # type: ignore[misc]
    runners: ClassVar[list[int]] = []

    def on_env_runners_recreated(self, *, env_runner_indices: list[int], **_: Any) -> None:
        self.runners.extend(env_runner_indices)


def kill_runner(algo: TAC) -> None:
    (pid,) = algo._call_runners(lambda runner: os.getpid())
    assert pid != os.getpid()
    os.kill(pid, signal.SIGKILL)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")  # Ray prints warnings
def test_a_killed_runner_changes_no_number(tmp_path: Path) -> None:
    unbroken = remote_runner()
    expected = [fingerprint(unbroken, 1) for _ in range(4)]
    unbroken.stop()
    algo = remote_runner()
    algo.callbacks.append(Restarts())
    kill_runner(algo)
    assert fingerprint(algo, 1) == expected[0]
    assert Restarts.runners == [1]
    assert fingerprint(algo, 1) == expected[1]
    kill_runner(algo)
    assert fingerprint(algo, 1) == expected[2]
    algo.save_to_path(tmp_path / "checkpoint")
    algo.stop()
    resumed = remote_runner()
    resumed.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(resumed, 1) == expected[3]
    resumed.stop()


class Failing(gym.Env[Any, Any]):
    """An environment that raises an error `count` times, counted by the lines of a file."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, path: Path, count: int) -> None:
        self.path, self.count = path, count

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = 5
        return self.observation(), {}

    def observation(self) -> Any:
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        failed = self.path.read_text() if self.path.exists() else ""
        if self.left == 2 and len(failed) < self.count:
            self.path.write_text(failed + ".")
            raise ArithmeticError("the robot's arm is folded")
        return self.observation(), float(action[0]), False, self.left == 0, {}


def of_failing(path: Path, count: int) -> TAC:
    tune.register_env("Failing", lambda _: Failing(path, count))
    config = TACConfig().environment("Failing")
    config.env_runners(num_env_runners=1).fault_tolerance(delay_between_env_runner_restarts_s=0)
    config.training(hidden_sizes=(4,), batch_size=4, random_steps=5, max_episode_steps=5).debugging(
        seed=0
    )
    config.reporting(min_sample_timesteps_per_iteration=1).evaluation(evaluation_interval=100)
    algo: TAC = config.build_algo()
    return algo


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")  # Ray prints warnings
def test_an_error_that_recurs_in_a_new_process_is_raised_with_its_traceback(tmp_path: Path) -> None:
    unbroken = of_failing(tmp_path / "unbroken", 0)
    expected = fingerprint(unbroken, 2)
    unbroken.stop()
    once = of_failing(tmp_path / "once", 1)
    assert fingerprint(once, 2) == expected
    once.stop()
    always = of_failing(tmp_path / "always", 1_000)
    with pytest.raises(RuntimeError, match="the robot's arm is folded"):
        always.train()
    always.stop()
