"""Python programs in processes of their own, and waiting for them."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def fresh(
    *arguments: object, code: int | None = 0, timeout: float = 280, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments to its end, and check the exit code unless it is None."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout,
        **options,
    )
    assert code is None or done.returncode == code, done.stdout + done.stderr
    return done


def wait_until(condition: Callable[[], T | None], seconds: float) -> T:
    """Call `condition` until its result is true; returns the result."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not in {seconds} s"
        time.sleep(0.05)
    return found
