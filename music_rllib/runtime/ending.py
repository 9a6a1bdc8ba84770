"""How a driver ends whose main thread may be blocked for good: in a thread, and in any case."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from typing import NoReturn


def try_for(seconds: float, *steps: Callable[[], object]) -> None:
    """Take each step, whatever becomes of the others, and wait so long at most for all of them."""

    def take() -> None:
        for step in steps:
            with contextlib.suppress(Exception):
                step()

    thread = threading.Thread(target=take, name="last-steps", daemon=True)
    thread.start()
    thread.join(seconds)


def end_process(code: int) -> NoReturn:
    """End as `kill -9` would, which a sweep survives; Ray's processes end with their driver."""
    show_cursor = b"\x1b[?25h\n" if sys.stdout.isatty() else b""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        os.write(sys.stdout.fileno(), show_cursor)
    os._exit(code)
