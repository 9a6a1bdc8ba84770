"""`kill -9` of remote environment runners, whose episodes are played again identically."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any, ClassVar

import pytest
from ray.rllib.callbacks.callbacks import RLlibCallback

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
