"""Ending a process that hangs."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from typing import NoReturn


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
