"""`kill -9` of the driver: whatever it was doing, the sweep ends with the same numbers."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from tests.faults import comparison

FIRST_SIGN = 120.0
"""Seconds that a start may take on a busy machine."""


def lines_of(document: dict[str, Any]) -> dict[str, Any]:
    """Long enough to be killed often, with a checkpoint every few rounds."""
    document["defaults"]["env_steps"] = 4000
    document["defaults"]["evaluation"] = {"interval": 400, "episodes": 2}
    document["checkpoints"] = {"minutes": 0.0001}
    return document


def kill(process: subprocess.Popen[str]) -> str:
    """`kill -9` the driver alone; Ray's processes must notice by themselves."""
    os.kill(process.pid, signal.SIGKILL)
    output, _ = process.communicate(timeout=60)
    return output


def unbroken(program: Any, document: dict[str, Any]) -> Path:
    """The storage of the same sweep, run in one go."""
    program.write(document | {"storage": "unbroken"})
    code, output, errors = program.run()
    assert (code, errors) == (0, ""), output
    return Path(program.folder, "unbroken")


def start_until_a_sign(program: Any, signs: tuple[str, ...]) -> subprocess.Popen[str]:
    """Start and read until a line has one of `signs`, or the end."""
    process: subprocess.Popen[str] = program.start()
    assert process.stdout is not None
    deadline = time.monotonic() + FIRST_SIGN
    for line in process.stdout:
        if any(sign in line for sign in signs) or time.monotonic() > deadline:
            break
    return process


@pytest.mark.parametrize("sign", ["pretrain/Point/seed0: 1,", "finetune/Point"])
def test_killed_once(sweep_program: Any, sweep_document: dict[str, Any], sign: str) -> None:
    """In pretraining, and right after the handoff."""
    document = lines_of(sweep_document)
    document["stages"][1]["grid"]["tac.entropic_index"] = [1.5]
    expected = unbroken(sweep_program, document)
    sweep_program.write(document)
    kill(start_until_a_sign(sweep_program, (sign,)))
    code, output, errors = sweep_program.run()
    assert (code, errors) == (0, ""), output
    comparison.same(expected, sweep_program.folder / "results")


@pytest.mark.thorough
@pytest.mark.timeout(3600)
def test_killed_twenty_times_at_random_moments(
    sweep_program: Any, sweep_document: dict[str, Any]
) -> None:
    """In the plan, while Ray starts, in each stage, in checkpoints and while MLflow is fed."""
    document = lines_of(sweep_document)
    expected = unbroken(sweep_program, document)
    sweep_program.write(document)
    seed = random.randrange(10**6)
    print(f"seed {seed}")
    rng, kills = random.Random(seed), 0
    while kills < 20:
        # Before Ray is up there is little to break: mostly a moment in training.
        signs = rng.choice([("starting a local Ray",), *[(": started", ": continues")] * 4])
        process = start_until_a_sign(sweep_program, signs)
        time.sleep(rng.uniform(0.0, 6.0))
        if process.poll() is not None:  # it had finished: once more, from nothing
            assert process.returncode == 0, process.communicate()
            comparison.same(expected, sweep_program.folder / "results")
            (sweep_program.folder / "results").rename(sweep_program.folder / f"done-{kills}")
            continue
        kill(process)
        kills += 1
    code, output, errors = sweep_program.run(timeout=600)
    assert (code, errors) == (0, ""), output
    comparison.same(expected, sweep_program.folder / "results")
