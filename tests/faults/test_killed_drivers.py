"""Killed and stopped drivers and workers: the sweep ends with the same numbers."""

from __future__ import annotations

import contextlib
import os
import random
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from music_rllib.program import main
from music_rllib.tune.events import RESTARTS
from tests.faults import comparison, sweeps
from tests.integration.conftest import Program, call, read_until
from tests.processes import wait_until


@pytest.mark.thorough
def test_a_killed_worker_then_sigterm_then_a_killed_driver(
    program: Program, unbroken: Path
) -> None:
    """Kill in pretraining, after the handoff, and after the resume."""
    process = sweeps.start_until(program, "pretrain/seed0: started")
    sweeps.kill_a_worker(process)
    output = read_until(process, ": FAILED", "finetune/q=1/seed0: s")
    assert "The worker process died" in output
    assert f"Another worker resumes from the last checkpoint (1 of {RESTARTS} times)." in output
    process.send_signal(signal.SIGTERM)
    output = sweeps.ended(process, 128 + signal.SIGTERM)
    assert "continue with: python -m music_rllib.sweep" in output

    process = sweeps.start_until(program, "finetune", "Results of")
    sweeps.kill(process)
    output = sweeps.finish(program)
    assert "pretrain/seed0: finished earlier, reused" in output
    comparison.same(unbroken, program.folder / "results")


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("sign", ["starting a local Ray", "pretrain/seed0: ", "finetune/"])
def test_stopped_in_each_stage(
    number: signal.Signals, sign: str, program: Program, unbroken: Path
) -> None:
    process = sweeps.start_until(program, sign)
    time.sleep(1.0)
    process.send_signal(number)
    output, errors = process.communicate(timeout=sweeps.PATIENCE)
    if sign == "starting a local Ray":  # nothing to save yet
        assert process.returncode in {128 + number, -number}, output + errors
    else:
        assert process.returncode == 128 + number, output + errors
    # It resumes from the state saved on the signal: no step is repeated.
    saved = dict(re.findall(r"\] (\S+): saved at ([\d,]+) env steps", output))
    output = sweeps.finish(program)
    continued = dict(re.findall(r"\] (\S+): continues at ([\d,]+) env steps", output))
    assert saved.items() <= continued.items()
    comparison.same(unbroken, program.folder / "results")


@pytest.mark.thorough
def test_a_signal_to_the_process_group_changes_no_number(program: Program, unbroken: Path) -> None:
    """SIGTERM as sent by `timeout` and Slurm: Ray ends too, before anything can be saved."""
    process = sweeps.start_until(program, "pretrain/seed0: started")
    time.sleep(1.0)
    os.killpg(process.pid, signal.SIGTERM)
    output = sweeps.ended(process, 128 + signal.SIGTERM)
    assert "Ray was told to stop as well" in output
    assert "continue with: python -m music_rllib.sweep" in output
    sweeps.finish(program)
    comparison.same(unbroken, program.folder / "results")


@pytest.mark.thorough
def test_a_second_signal_ends_it_at_once(program: Program, unbroken: Path) -> None:
    process = sweeps.start_until(program, "pretrain/seed0: started")
    process.send_signal(signal.SIGINT)
    read_until(process, "stopping, this takes a few seconds")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=sweeps.PATIENCE)
    assert process.returncode == 128 + signal.SIGINT
    assert "At once: Stopped. Finished runs and the last checkpoints are kept; continue " in errors
    sweeps.finish(program)
    comparison.same(unbroken, program.folder / "results")


@pytest.mark.thorough
def test_a_run_whose_worker_dies_repeatedly_fails_with_the_cause(
    program: Program, unbroken: Path
) -> None:
    document = sweeps.document()
    document["defaults"]["env_steps"] = 200_000
    document["stages"] = document["stages"][:1]
    program.write(document)
    process = sweeps.start_until(program, "] seed0: started")
    for attempt in range(RESTARTS + 1):
        sweeps.kill_a_worker(process)
        last = "The same command again continues from the last checkpoint"
        sign = last if attempt == RESTARTS else "] seed0: started"
        output = read_until(process, sign)
    assert ": FAILED: The worker process died" in output
    assert last in output
    sweeps.ended(process, 1)


@pytest.mark.thorough
@pytest.mark.timeout(5400)
def test_killed_twenty_times_at_random_moments(program: Program, unbroken: Path) -> None:
    """Kill during planning, the start of Ray, each stage, checkpoints and sending to MLflow."""
    seed = int(os.environ.get("FAULT_SEED", random.randrange(10**6)))
    print(f"FAULT_SEED={seed}")
    rng, kills, results = random.Random(seed), 0, program.folder / "results"
    while kills < 20:
        # Before Ray runs there is little state to break, so mostly during training.
        signs = rng.choice([("starting a local Ray",), *[(": started", ": continues")] * 4])
        process = sweeps.start_until(program, *signs, "Results of")
        time.sleep(rng.uniform(0.0, 10.0))
        if process.poll() is None:
            sweeps.kill(process)
            kills += 1
            continue
        output, errors = process.communicate()
        assert process.returncode == 0, output + errors
        comparison.same(unbroken, results)
        results.rename(program.folder / f"done-{kills}")  # the next attempt, from scratch
    sweeps.finish(program)
    comparison.same(unbroken, results)


@pytest.mark.thorough
def test_an_array_of_tasks_is_stopped_killed_and_requeued(
    program: Program, unbroken: Path, tmp_path: Path
) -> None:
    """The script of `slurm` with three tasks: one gets SIGTERM, one is killed, one stays."""
    stubs = tmp_path / "stubs"
    stubs.mkdir()
    (stubs / "scontrol").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/requeued\n')
    (stubs / "scontrol").chmod(0o755)
    written = call(main, program.folder, "slurm", program.file, "--storage", "results")
    assert written[::2] == (0, "")
    (script,) = program.folder.glob("*.slurm.sh")

    def task(number: int) -> subprocess.Popen[bytes]:
        environment = program.environment | {
            "PATH": f"{stubs}:{os.environ['PATH']}",
            "SLURM_JOB_ID": str(number),
            "SLURM_ARRAY_TASK_ID": str(number),
            "SLURM_CPUS_PER_TASK": "1",
        }
        with (tmp_path / f"{number}.log").open("ab") as log:
            return subprocess.Popen(
                ["sh", script],
                cwd=program.folder,
                env=environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def with_sign(sign: str) -> int:
        """The task whose log has `sign`."""

        def found() -> list[int]:
            return [int(log.stem) for log in tmp_path.glob("*.log") if sign in log.read_text()]

        return wait_until(found, sweeps.FIRST_SIGN)[0]

    tasks = {number: task(number) for number in (1, 2, 3)}
    try:
        first = with_sign("pretrain/seed0: 0 of 4,000 env steps")
        tasks[first].terminate()
        assert tasks[first].wait(sweeps.PATIENCE) == 128 + signal.SIGTERM
        assert (tmp_path / "requeued").read_text() == f"requeue {first}\n"
        second = with_sign("pretrain/seed0: continues at ")
        os.killpg(tasks[second].pid, signal.SIGKILL)
        tasks[second].wait()
        tasks |= {number: task(number) for number in (first, second)}
        assert [one.wait(sweeps.PATIENCE) for one in tasks.values()] == [0, 0, 0]
    finally:
        for one in tasks.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(one.pid, signal.SIGKILL)
    assert sweeps.finish(program).count(": finished earlier, reused") == 3, "MLflow has all runs"
    comparison.same(unbroken, program.folder / "results")
