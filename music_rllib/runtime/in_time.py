"""What a user's code does in this process is ended where it takes too long."""

from __future__ import annotations

import contextlib
import faulthandler
import sys
import threading
from collections.abc import Iterator

from music_rllib.errors import BAD_INPUT
from music_rllib.runtime.ending import end_process

STDERR = 2
SLACK = 5.0
"""Seconds after which the message is left out, as code that holds Python's lock leaves no room."""


@contextlib.contextmanager
def in_time(seconds: float | None, rule: str) -> Iterator[None]:
    """End the program, with the stack, where this `with` takes longer; None: never.

    Args:
        seconds: How long it may take.
        rule: What took longer than what, for the message.
    """
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
