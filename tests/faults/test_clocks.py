"""The system time changes while a sweep runs, for its driver and all of its workers.

A module that Python imports at its start changes it. libfaketime does not work: with it,
`time.sleep` of Python 3.11 fails if only the time of day is changed (EINVAL, version 0.9.10 of
Debian 12).
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.faults import comparison, sweeps
from tests.integration.conftest import Program, read_until

pytestmark = pytest.mark.thorough

HOUR = 3600
CLOCK = """
import os, time
_time, _time_ns = time.time, time.time_ns
def ahead():
    with open(os.environ["TEST_CLOCK"]) as file:
        return int(file.read())
time.time = lambda: _time() + ahead()
time.time_ns = lambda: _time_ns() + ahead() * 10**9
"""


class Clock:
    """The system time of a program and of the processes that it starts."""

    def __init__(self, program: Program, folder: Path) -> None:
        self._file = folder / "clock"
        self.set(0)
        (folder / "sitecustomize.py").write_text(CLOCK)
        paths = f"{folder}:{program.environment['PYTHONPATH']}"
        program.environment |= {"PYTHONPATH": paths, "TEST_CLOCK": str(self._file)}

    def set(self, seconds: int) -> None:
        """Shift the time by some seconds."""
        fresh = self._file.with_suffix(".new")
        fresh.write_text(str(seconds))
        fresh.replace(self._file)


@pytest.fixture
def clock(program: Program, tmp_path: Path) -> Clock:
    folder = tmp_path / "clock"
    folder.mkdir()
    return Clock(program, folder)


def test_a_clock_that_jumps_forward_and_back(
    program: Program, clock: Clock, unbroken: Path, tmp_path: Path
) -> None:
    process = sweeps.start_until(program, "pretrain/seed0: 8")
    clock.set(HOUR)
    read_until(process, "finetune/q=1/seed0: 8")
    clock.set(-HOUR)
    output = sweeps.ended(process)
    assert "taken over" not in output
    comparison.same(unbroken, tmp_path / "results")


def test_killed_with_a_fast_clock_and_resumed(
    program: Program, clock: Clock, unbroken: Path, tmp_path: Path
) -> None:
    """Leases of dead processes that expire in an hour do not delay other processes."""
    process = sweeps.start_until(program, "pretrain/seed0: 8")
    clock.set(HOUR)
    read_until(process, "pretrain/seed0: finished")
    for worker in sweeps.workers(process):
        worker.send_signal(signal.SIGKILL)
    sweeps.kill(process)
    clock.set(0)
    output = sweeps.finish(program)
    assert "pretrain/seed0: finished earlier, reused" in output
    comparison.same(unbroken, tmp_path / "results")
