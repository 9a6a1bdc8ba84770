"""A process that kills a worker whose environment hangs, and records the worker's stack.

If a call of `step()` or `reset()` takes too long, the watching process makes the worker write its
stack (`faulthandler` does not need Python's lock), copies the stack into the run's work folder and
kills the worker. The next worker of the run finds the record and fails the run. Until then, the
watching process imports only Python's own modules.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

RECORD = "hung.txt"
"""File in a run's work folder: the attempt, the seconds that it hung, and the stack."""
LOOKS = 20
"""Number of looks of the watching process during the time limit of a call."""
LONGEST_PAUSE, DUMP_SECONDS = 5.0, 5.0


class HangError(RuntimeError):
    """An environment did not return; the message has the stack in which it hangs."""


class HangWatch:
    """The worker's side; the worker is watched until `end`."""

    def __init__(self, seconds: float, storage: str, key: str, attempt: str) -> None:
        """Start the watching process.

        Args:
            seconds: Maximum duration of one call of the environment.
            storage: The record is written to `work/<key>` in this storage.
            key: The run's key.
            attempt: Name of this attempt, which earlier records do not have.

        Raises:
            OSError: The watching process can't be started.
        """
        import faulthandler

        from music_rllib.envs.make import in_environment
        from music_rllib.runtime.machine import own_folder

        self._calls = in_environment
        self._files = contextlib.ExitStack()
        folder = Path(self._files.enter_context(own_folder("music-hang-")))
        calls, stack = folder / "calls", folder / "stack"
        self._calls.share(calls)
        self._stack = stack.open("w")
        faulthandler.register(signal.SIGUSR2, self._stack, all_threads=True)
        names = (str(calls), str(stack), f"work/{key}/{RECORD}", attempt)
        self._process = subprocess.Popen(  # noqa: S603
            # -P: no module of this file's folder may replace one of Python.
            [sys.executable, "-P", __file__, str(os.getpid()), str(seconds), *names],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        assert self._process.stdin is not None
        # Not an argument: the URI may hold a key, and every user can read command lines.
        self._process.stdin.write(os.fsencode(f"{storage}\n"))
        self._process.stdin.flush()

    def end(self) -> None:
        import faulthandler

        assert self._process.stdin is not None
        self._process.stdin.close()  # which ends the process
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=5.0)
        self._calls.unshare()
        faulthandler.unregister(signal.SIGUSR2)
        self._stack.close()
        self._files.close()


def check_hung(record: str | None, attempt: str, what: str) -> None:
    """Fail if a worker hung in this attempt.

    Args:
        record: The content of the record, if there is one.
        attempt: Records of other attempts are ignored, as the environment may be fixed since.
        what: The environment, for the message.

    Raises:
        HangError: The worker before this one hung.
    """
    if record is None:
        return
    recorded_attempt, seconds, stack = (*record.split("\n", 2), "", "")[:3]
    if recorded_attempt != attempt:
        return
    places = (place_in(stack, file) for file in ("env_runner.py", "goal_functions.py"))
    place = next(filter(None, places), "an unknown place")
    raise HangError(
        f"environment {what} has not returned from {_call_in(stack)} for {float(seconds):g} s "
        f"(resources.hang_minutes)\nit hangs at {place}\n{stack}"
    )


def place_in(stack: str, file: str) -> str | None:
    """The innermost line of the thread that runs `file`, in a stack that `faulthandler` wrote."""
    for thread in stack.split("\n\n"):
        if file in thread:
            return next(line.strip() for line in thread.splitlines() if line.startswith("  File "))
    return None


def _call_in(stack: str) -> str:
    if "env_runner.py" not in stack:
        return "step() or reset()"
    return "reset()" if " in _start_episode" in stack else "step()"


# -- the watching process ---------------------------------------------------------------------


def main() -> None:
    """Watch the process that the arguments name until it ends or hangs."""
    pid, seconds, calls, stack, record, attempt = sys.argv[1:]
    storage = os.fsdecode(sys.stdin.buffer.readline()).rstrip("\n")
    try:
        if not _hangs(int(pid), float(seconds), Path(calls)):
            return
        text = _dump(int(pid), Path(stack))
    finally:
        shutil.rmtree(Path(calls).parent, ignore_errors=True)
    # Imported only now, because they take tens of megabytes.
    from music_rllib.store.storage import StorageError, open_storage

    with contextlib.suppress(OSError, StorageError):  # kill the worker in any case
        open_storage(storage).write(record, f"{attempt}\n{seconds}\n{text}".encode())
    os.kill(int(pid), signal.SIGKILL)


def _hangs(pid: int, seconds: float, calls: Path) -> bool:
    """Wait until one call has taken too long; False if the watched process ends first.

    The time is counted in looks that find the same call, so it does not include the time while the
    machine slept or the worker was stopped.
    """
    pause = min(seconds / LOOKS, LONGEST_PAUSE)
    seen, stalled = 0, 0.0
    while not select.select([sys.stdin], [], [], pause)[0] and os.getppid() == pid:
        number = struct.unpack("q", calls.read_bytes())[0]
        stuck = number % 2 == 1 and number == seen and not _is_stopped(pid)
        stalled = stalled + pause if stuck else 0.0
        seen = number
        if stalled >= seconds:
            return True
    return False


def _is_stopped(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False


def _dump(pid: int, stack: Path) -> str:
    os.kill(pid, signal.SIGUSR2)
    deadline, before = time.monotonic() + DUMP_SECONDS, ""
    while time.monotonic() < deadline:
        time.sleep(0.2)
        text = stack.read_text(errors="replace")
        if text and text == before:
            break
        before = text
    return before


if __name__ == "__main__":
    main()
