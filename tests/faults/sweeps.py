"""The small sweep into which faults are injected, and the processes that run it."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import yaml

from tests.integration.conftest import SWEEP, Program, end, program_environment, read_until
from tests.processes import fresh, wait_until

FIRST_SIGN = 400.0
"""Timeout of a start on a busy machine, in seconds."""
PATIENCE = 900.0
"""Timeout of a whole sweep, in seconds."""


def document(**changes: Any) -> dict[str, Any]:
    """A sweep of three short runs, with a checkpoint at every report."""
    whole: dict[str, Any] = yaml.safe_load(yaml.safe_dump(SWEEP))
    whole["defaults"]["env_steps"] = 4000
    whole["checkpoints"] = {"minutes": 0.0001}
    return whole | changes


@dataclass
class OwnProgram(Program):
    """A program whose processes always end with the test."""

    started: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self, *options: str, command: str = "run") -> subprocess.Popen[str]:
        self.started.append(super().start(*options, command=command))
        return self.started[-1]

    def end_all(self) -> None:
        for process in self.started:
            end(process)
            for stream in (process.stdout, process.stderr):
                assert stream is not None
                stream.close()


def program(folder: Path) -> OwnProgram:
    """The program in `folder`."""
    return OwnProgram(folder, program_environment())


def start_until(program: Program, *signs: str) -> subprocess.Popen[str]:
    """Start the program and read until a line contains one of `signs`, or to the end."""
    process = program.start()
    read_until(process, *signs)
    return process


def ended(process: subprocess.Popen[str], code: int = 0) -> str:
    """Wait for the end with this exit code; returns the rest of the output."""
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == code, output + errors
    return output


def kill(process: subprocess.Popen[str]) -> None:
    """`kill -9` only the driver; Ray's processes must notice it."""
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=PATIENCE)


def workers(process: subprocess.Popen[str]) -> Iterator[psutil.Process]:
    """Worker processes of a driver with a local Ray."""
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if child.cmdline()[0].startswith("ray::RunTrainable"):
                yield child
        except (psutil.Error, IndexError):
            continue


def kill_a_worker(process: subprocess.Popen[str]) -> None:
    """`kill -9` a worker as soon as one is training."""
    worker = wait_until(lambda: next(workers(process), None), FIRST_SIGN)
    os.kill(worker.pid, signal.SIGKILL)


def finish(program: Program, timeout: float = PATIENCE) -> str:
    """Run to the successful end; returns the output."""
    code, output, errors = program.run(timeout=timeout)
    assert code == 0, output + errors
    return output


def resume(program: Program, code: int = 0) -> str:
    """The command that a sweep names when MLflow lacks records; returns its output."""
    command = ("-m", "music_rllib.sweep", "resume", "results/points")
    place: Any = {"cwd": program.folder, "env": program.environment}
    done = fresh(*command, code=code, timeout=PATIENCE, **place)
    return done.stdout + done.stderr
