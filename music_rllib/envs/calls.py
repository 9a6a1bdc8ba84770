"""Whether this process is in a call of an environment: one number, which another process may read.

An environment may hang while it holds Python's lock, so nothing in the same process can tell.
"""

from __future__ import annotations

import mmap
from pathlib import Path

__all__ = ["Calls", "in_environment"]

BYTES = 8


class Calls:
    """`with in_environment: env.step(...)` makes the number odd, and even again; about 0.2 us."""

    def __init__(self) -> None:
        self.unshare()

    def __enter__(self) -> None:
        self._number[0] += 1

    def __exit__(self, *_: object) -> None:
        self._number[0] += 1

    def share(self, path: Path) -> None:
        """Keep the number in this file from now on; not within a call.

        Raises:
            OSError: The file can't be written.
        """
        path.write_bytes(bytes(BYTES))
        with path.open("r+b") as file:
            self._number = memoryview(mmap.mmap(file.fileno(), BYTES)).cast("q")

    def unshare(self) -> None:
        """Keep the number in this process."""
        self._number = memoryview(bytearray(BYTES)).cast("q")


in_environment = Calls()
"""Of this process: its environments are called one after another."""
