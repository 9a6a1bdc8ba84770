"""A sweep as a user starts it, on a very cheap environment."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from music_rllib import names

REPOSITORY = Path(__file__).parents[2]
ENVIRONMENTS = Path(__file__).parents[1] / "environments"

POINT: dict[str, Any] = {
    "env_id": "point_env:Point-v0",
    "horizon": 20,
    "agent_indices": [0, 1],
    "surrounding_indices": [2, 3],
}
SWEEP: dict[str, Any] = {
    "name": "points",
    "tasks": ["Point"],
    "storage": "results",
    "resources": {"num_cpus": 2},
    "environments": {"Point": POINT},
    "defaults": {
        "env_steps": 1200,
        "num_envs": 2,
        "evaluation": {"interval": 400, "episodes": 2},
        "tac": {"random_steps": 200, "hidden_sizes": [16], "batch_size": 16, "replay_ratio": 0.2},
        "music": {"batch_trajectories": 4, "hidden_size": 16},
    },
    "stages": [
        {"name": "pretrain", "variant": "music-u"},
        {
            "name": "finetune",
            "variant": "music-r",
            "init_from": "pretrain",
            "grid": {"tac.entropic_index": [1.0, 2.0]},
        },
    ],
}
"""A small whole sweep; tests change the settings that they test."""


@dataclass
class Program:
    """`python -m music_rllib.sweep` in its own folder."""

    folder: Path
    environment: dict[str, str]
    file: str = "sweep.yaml"
    """The sweep's file below `folder`."""

    def write(self, document: dict[str, Any]) -> None:
        """Write `document` to the program's file."""
        (self.folder / self.file).write_text(yaml.safe_dump(document, sort_keys=False))

    def start(self, *options: str, command: str = "run") -> subprocess.Popen[str]:
        """Start it in its own process group."""
        return subprocess.Popen(
            [sys.executable, "-m", "music_rllib.sweep", command, self.file, *options],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(
        self, *options: str, command: str = "run", timeout: float = 240
    ) -> tuple[int, str, str]:
        """Run it to its end; returns exit code, standard output, standard error."""
        process = self.start(*options, command=command)
        try:
            output, errors = process.communicate(timeout=timeout)
        finally:
            end(process)
        return process.returncode, output, errors

    def start_until(self, wanted: str, timeout: float = 120) -> subprocess.Popen[str]:
        """Start it and wait for a line that contains `wanted`."""
        process = self.start()
        seen = read_until(process, wanted, timeout=timeout)
        if wanted in seen:
            return process
        end(process)
        pytest.fail(f"no {wanted!r} in:\n{seen}{process.communicate()[1]}")


def read_until(process: subprocess.Popen[str], *signs: str, timeout: float = 400) -> str:
    """Read until a line contains one of `signs`, or for `timeout` seconds; returns the lines."""
    assert process.stdout is not None
    deadline, seen = time.monotonic() + timeout, []
    for line in process.stdout:
        seen.append(line)
        if any(sign in line for sign in signs) or time.monotonic() > deadline:
            break
    return "".join(seen)


def call(
    main: Callable[[Sequence[str]], int], folder: Path, *arguments: str
) -> tuple[int, str, str]:
    """Run one of the package's programs in this process, in `folder`: exit code, output and errors.

    For short commands: in a process of their own they would load Python's libraries again.
    """
    output, errors = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        code = main(arguments)
    return code, output.getvalue(), errors.getvalue()


def end(process: subprocess.Popen[str]) -> None:
    """End the processes that `Program.start` started, and their children."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def rows(output: str) -> list[list[str]]:
    """Cells of the table of results that a sweep prints at its end."""
    table = output[output.index("Results of") :]
    lines = [line for line in table.splitlines() if re.match(r"\S*seed\d+ ", line)]
    return [re.split(r"\s{2,}", line.strip()) for line in lines]


def metric_steps(folder: Path, run: Any, name: str = names.ENV_STEPS) -> list[int]:
    """Environment steps at which the embedded MLflow of a sweep in `folder` has a run's metric."""
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{folder}/results/mlflow.db")
    return [metric.step for metric in client.get_metric_history(run.info.run_id, name)]


def listening(process: subprocess.Popen[Any]) -> dict[str, set[str]]:
    """Address to the names of the processes below `process` that listen there."""
    found: dict[str, set[str]] = {}
    own = psutil.Process(process.pid)
    for one in [own, *own.children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess):
            for connection in one.net_connections("inet"):
                if connection.status == psutil.CONN_LISTEN:
                    found.setdefault(connection.laddr.ip, set()).add(one.name())
    return found


@pytest.fixture
def sweep_document() -> dict[str, Any]:
    """A small whole sweep for changes by tests."""
    return yaml.safe_load(yaml.safe_dump(SWEEP))  # type: ignore[no-any-return]


def program_environment() -> dict[str, str]:
    """This process's variables, which make the test environments importable in all processes."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (REPOSITORY, ENVIRONMENTS)))}


def mlflow_runs_of(folder: Path, database: str = "results/mlflow.db") -> dict[str, Any]:
    """All runs in MLflow's database of a sweep in `folder`, by name."""
    from mlflow import MlflowClient

    return runs_by_name(MlflowClient(f"sqlite:///{folder}/{database}"))


def runs_by_name(client: Any, experiment: str = "points") -> dict[str, Any]:
    """All runs of an experiment in MLflow, by name; fails if a name occurs twice."""
    found = client.get_experiment_by_name(experiment)
    assert found is not None
    runs = list(client.search_runs([found.experiment_id]))
    by_name = {run.info.run_name: run for run in runs}
    assert len(by_name) == len(runs), sorted(run.info.run_name for run in runs)
    return by_name


@pytest.fixture
def sweep_program(tmp_path: Path) -> Program:
    """The program in the test's folder."""
    return Program(tmp_path, program_environment())


@pytest.fixture
def mlflow_runs(tmp_path: Path) -> Callable[[], dict[str, Any]]:
    """All runs in the embedded MLflow of `sweep_program`, by name."""
    return partial(mlflow_runs_of, tmp_path)
