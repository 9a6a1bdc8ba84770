"""Ending a process that hangs."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import sys
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

from music_rllib.errors import BAD_INPUT

STDERR = 2
SLACK = 5.0
"""Seconds after the limit until only the stack is printed, if code holds Python's lock."""


def try_for(seconds: float, *steps: Callable[[], object]) -> None:
    """Run all steps in a thread, ignoring exceptions, and wait at most `seconds` for them."""

    def run() -> None:
        for step in steps:
            with contextlib.suppress(Exception):
                step()

    thread = threading.Thread(target=run, name="last-steps", daemon=True)
    thread.start()
    thread.join(seconds)


def end_process(code: int) -> NoReturn:
    """End at once, as `kill -9` would. A sweep survives that, and Ray ends with its driver."""
    show_cursor = b"\x1b[?25h\n" if sys.stdout.isatty() else b""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        os.write(sys.stdout.fileno(), show_cursor)
    os._exit(code)


@contextlib.contextmanager
def in_time(seconds: float | None, rule: str) -> Iterator[None]:
    """End the program, with `rule` and its stack, if this `with` takes longer than `seconds`."""
    if seconds is None:
        yield
        return

    def end() -> None:
        print(f"error: {rule}; it hangs at:", file=sys.stderr, flush=True)
        faulthandler.dump_traceback(STDERR, all_threads=True)
        end_process(BAD_INPUT)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    faulthandler.dump_traceback_later(seconds + SLACK, exit=True, file=STDERR)
    try:
        yield
    finally:
        timer.cancel()
        faulthandler.cancel_dump_traceback_later()
