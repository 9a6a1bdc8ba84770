"""An environment that hangs is named with its stack, and the other runs continue."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from music_rllib.tac.env_runner import TrajectoryEnvRunner
from music_rllib.training.hang_watch import RECORD, HangError, check_hung
from tests.faults import sweeps
from tests.integration.conftest import ENVIRONMENTS, REPOSITORY, Program

WORKER = """
import sys, time
from music_rllib.envs.make import in_environment
from music_rllib.training.hang_watch import HangWatch
from point_env import Hanging

watch = HangWatch(1.0, sys.argv[1], "key", "attempt")
print("watched", flush=True)
if sys.argv[2] == "works":
    for _ in range(30):
        with in_environment:
            time.sleep(0.05)
    time.sleep(2.5)  # like a long update
else:
    with in_environment:
        if sys.argv[2] == "stopped":
            time.sleep(0.3)
        else:
            Hanging(locked=sys.argv[2] == "locked").hang()
watch.end()
"""


def temporary_folder(storage: Path) -> Path:
    folder = storage.with_name(f"{storage.name}-temporary")
    folder.mkdir(exist_ok=True)
    return folder


def leaves_nothing_behind(storage: Path) -> bool:
    """The watching process ends shortly after the watched one."""
    deadline = time.monotonic() + 10
    while any(temporary_folder(storage).iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not any(temporary_folder(storage).iterdir())


def worker(storage: Path, what: str) -> subprocess.Popen[str]:
    paths = os.pathsep.join(map(str, (REPOSITORY, ENVIRONMENTS)))
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, str(storage), what],
        env=os.environ | {"PYTHONPATH": paths, "TMPDIR": str(temporary_folder(storage))},
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("what", ["free", "locked"])
def test_a_call_that_does_not_return_ends_the_worker_and_leaves_its_stack(
    what: str, tmp_path: Path
) -> None:
    with worker(tmp_path, what) as process:
        assert process.wait(timeout=60) == -signal.SIGKILL
    record = (tmp_path / "work" / "key" / RECORD).read_text()
    assert record.startswith("attempt\n1.0\n")
    assert 'point_env.py", line ' in record
    assert " in hang" in record
    with pytest.raises(HangError, match=r"environment Hanging-v0 has not returned from .* for 1 s"):
        check_hung(record, "attempt", "Hanging-v0")
    check_hung(record, "another attempt", "Hanging-v0")
    check_hung(None, "attempt", "Hanging-v0")
    assert leaves_nothing_behind(tmp_path)


@pytest.mark.parametrize("what", ["works", "stopped"])
def test_slow_calls_and_updates_are_not_hangs(what: str, tmp_path: Path) -> None:
    """Many short calls, a long update, and a process that was stopped during a call."""
    with worker(tmp_path, what) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "watched\n"
        (watching,) = psutil.Process(process.pid).children()
        # The URI of a storage may hold a key, and every user can read command lines.
        assert str(tmp_path) not in watching.cmdline()
        if what == "stopped":
            process.send_signal(signal.SIGSTOP)
            time.sleep(2.5)
            process.send_signal(signal.SIGCONT)
        assert process.wait(timeout=60) == 0
    assert not list(tmp_path.iterdir())
    assert leaves_nothing_behind(tmp_path)


def test_a_worker_that_is_killed_leaves_nothing_behind(tmp_path: Path) -> None:
    """If its watching process is killed too, the next worker removes the folder."""
    for watching_too in (True, False):
        with worker(tmp_path, "works") as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "watched\n"
            if watching_too:
                (watching,) = psutil.Process(process.pid).children()
                watching.kill()
            process.kill()
        if watching_too:
            assert len([*temporary_folder(tmp_path).iterdir()]) == 1
    assert leaves_nothing_behind(tmp_path)


BEGINS = TrajectoryEnvRunner._start_episode.__name__


@pytest.mark.parametrize(
    ("record", "call", "place"),
    [
        (
            "a\n300.0\nCurrent thread 0x1 (most recent call first):\n"
            '  File "/x/robot.py", line 7 in wait\n'
            '  File "/x/tac/env_runner.py", line 9 in _step\n\n'
            'Thread 0x2 (most recent call first):\n  File "/x/lease.py", line 1 in _renew\n',
            "step",
            'File "/x/robot.py", line 7 in wait',
        ),
        (
            'a\n300.0\nThread 0x2 (most recent call first):\n  File "/x/lease.py", line 1 in w\n\n'
            "Current thread 0x1 (most recent call first):\n"
            f'  File "/x/tac/env_runner.py", line 9 in {BEGINS}\n',
            "reset",
            f'File "/x/tac/env_runner.py", line 9 in {BEGINS}',
        ),
        ("a\n300.0\n", "step() or reset", "an unknown place"),
    ],
)
def test_the_message_names_the_call_and_the_place(record: str, call: str, place: str) -> None:
    with pytest.raises(HangError) as error:
        check_hung(record, "a", "E")
    first, second, *_ = str(error.value).splitlines()
    assert first == (
        f"environment E has not returned from {call}() for 300 s (resources.hang_minutes)"
    )
    assert second == f"it hangs at {place}"


def test_an_environment_that_hangs_in_the_checks_ends_the_program(program: Program) -> None:
    document = sweeps.document(tasks=["Hanging"])
    document["environments"] = {
        "Hanging": document["environments"]["Point"]
        | {"env_id": "point_env:Hanging-v0", "env_kwargs": {"at": 1, "locked": True}}
    }
    document["resources"] |= {"hang_minutes": 0.03}
    program.write(document)
    code, _, errors = program.run(command="plan", timeout=sweeps.PATIENCE)
    assert code == 2
    assert "error: environments.Hanging: step() must return within resources.hang_minu" in errors
    assert 'point_env.py", line ' in errors
    assert not (program.folder / "results").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("locked", [False, True])
def test_a_hanging_environment_fails_its_run_only(locked: bool, program: Program) -> None:
    document: dict[str, Any] = sweeps.document(tasks=["Point", "Hanging"])
    document["environments"]["Hanging"] = document["environments"]["Point"] | {
        "env_id": "point_env:Hanging-v0",
        "env_kwargs": {"at": 300, "locked": locked},
    }
    document["resources"] |= {"hang_minutes": 0.1}
    document["stages"] = document["stages"][:1]
    program.write(document)
    code, output, errors = program.run(timeout=sweeps.PATIENCE)
    assert code == 1, output + errors
    assert (
        "] Hanging/seed0: FAILED: HangError: environment point_env:Hanging-v0 has not "
        "returned from step() for 6 s (resources.hang_minutes)"
    ) in output
    assert f'it hangs at File "{ENVIRONMENTS}/point_env.py", line ' in output
    assert "] Point/seed0: finished" in output
    (log,) = (program.folder / "results" / "points" / "failures").glob("*Hanging*.txt")
    assert "env_runner.py" in log.read_text()
    assert "most recent call first" in log.read_text()
