"""Which finished runs have been read through, and not been touched since: nobody reads them twice.

A run is known by its files' places, sizes and times on the disk. That is a few microseconds for
each file, where reading and hashing it takes milliseconds.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from music_rllib.store.files import write_atomically

SETTLED_SECONDS = 2.0
"""A file that was written just now may be written again at what its disk calls the same time."""


def fingerprint(paths: Iterable[Path]) -> str | None:
    """What changes with any of the files; None while one of them is new.

    Raises:
        OSError: One can't be looked at.
    """
    digest, newest = hashlib.sha256(), 0
    for path in paths:
        found = path.stat()
        digest.update(
            f"{path.name} {found.st_dev} {found.st_ino} {found.st_size} {found.st_mtime_ns} "
            f"{found.st_ctime_ns}\n".encode()
        )
        newest = max(newest, found.st_mtime_ns, found.st_ctime_ns)
    return None if time.time() - newest / 1e9 < SETTLED_SECONDS else digest.hexdigest()[:20]


class Verified:
    """A file with the fingerprints of what was found sound. Whatever is in it, no error of it."""

    def __init__(self, path: Path) -> None:
        """Look at `path`, which need not exist, nor be writable."""
        self._path = path
        self._changed = False

    @cached_property
    def _known(self) -> dict[str, str]:
        with contextlib.suppress(OSError, ValueError):
            content = json.loads(self._path.read_bytes())
            if isinstance(content, dict):
                return {key: str(value) for key, value in content.items()}
        return {}

    def has(self, key: str, mark: str | None) -> bool:
        """Whether it was sound when it had this fingerprint."""
        return mark is not None and self._known.get(key) == mark

    def add(self, key: str, mark: str | None) -> None:
        """It is sound."""
        if mark is not None:
            self._known[key] = mark
            self._changed = True

    def keep(self) -> None:
        """Write it, where that can be done; what others have added meanwhile is lost."""
        if not self._changed:
            return
        with contextlib.suppress(OSError):
            data = json.dumps(self._known, indent=0).encode()
            write_atomically(self._path, data, sync=False)  # lost, it costs a second reading
            self._changed = False
