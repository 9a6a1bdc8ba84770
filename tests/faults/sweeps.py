"""The small sweep into which faults are injected, and the processes that run it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import yaml

from tests.integration.conftest import SWEEP, Program, end, program_environment

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


def read_until(process: subprocess.Popen[str], *signs: str) -> str:
    """Read until a line contains one of `signs`; returns the lines."""
    assert process.stdout is not None
    deadline, seen = time.monotonic() + FIRST_SIGN, []
    for line in process.stdout:
        seen.append(line)
        if any(sign in line for sign in signs) or time.monotonic() > deadline:
            break
    return "".join(seen)


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
    deadline = time.monotonic() + FIRST_SIGN
    while time.monotonic() < deadline:
        for worker in workers(process):
            os.kill(worker.pid, signal.SIGKILL)
            return
        time.sleep(0.1)
    raise AssertionError("no worker came up")


def finish(program: Program, timeout: float = PATIENCE) -> str:
    """Run to the successful end; returns the output."""
    code, output, errors = program.run(timeout=timeout)
    assert code == 0, output + errors
    return output


def resume(program: Program, code: int = 0) -> str:
    """The command that a sweep names when MLflow lacks records; returns its output."""
    done = subprocess.run(
        [sys.executable, "-m", "music_rllib.sweep", "resume", "results/points"],
        cwd=program.folder,
        env=program.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr
