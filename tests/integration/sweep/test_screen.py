"""What a person sees while third parties work: nothing, unless something is wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties
prepare_environment()
quiet_third_parties()

import logging
import gymnasium
import ray
from music_rllib.envs.tasks import register_robotics
from ray.rllib.algorithms.ppo import PPOConfig


def work(where):
    register_robotics()
    gymnasium.make("FetchPush-v4").close()
    config = PPOConfig().environment("Pendulum-v1").env_runners(num_env_runners=0)
    config.build_algo().stop()
    logging.getLogger("ray.rllib").error("wrong in the %s", where)


ray.init(
    address="local",
    num_cpus=1,
    include_dashboard=False,
    runtime_env={"worker_process_setup_hook": quiet_third_parties},
)
work("driver")
ray.get(ray.remote(work).remote("worker"))
"""


def test_third_parties_are_quiet_and_errors_are_not(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    home = tmp_path / "home"
    home.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment | {"HOME": str(home)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    assert len(lines) == 2, lines
    assert any("wrong in the driver" in line for line in lines)
    assert any("wrong in the worker" in line for line in lines)
    # Ray, left alone, would have written a token file that changes later `ray start`s.
    assert not (home / ".ray").exists()
