"""Remembers which finished runs were verified, so that unchanged files are not read again.

A run is recognised by the inodes, sizes and times of its files, which takes microseconds per file;
reading and hashing a file takes milliseconds.
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
"""A newer file may be written again without a change of its time stamp."""


def fingerprint_of(paths: Iterable[Path]) -> str | None:
    """A hash of the files' inodes, sizes and times; None if one of them is very new.

    Raises:
        OSError: The status of a file cannot be read.
    """
    digest, newest = hashlib.sha256(), 0
    for path in paths:
        status = path.stat()
        digest.update(
            f"{path.name} {status.st_dev} {status.st_ino} {status.st_size} {status.st_mtime_ns} "
            f"{status.st_ctime_ns}\n".encode()
        )
        newest = max(newest, status.st_mtime_ns, status.st_ctime_ns)
    return None if time.time() - newest / 1e9 < SETTLED_SECONDS else digest.hexdigest()[:20]


class Verified:
    """A file of fingerprints of sound runs; it need not be readable or writable."""

    def __init__(self, path: Path) -> None:
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
        """Whether the run was sound when it had the fingerprint `mark`."""
        return mark is not None and self._known.get(key) == mark

    def add(self, key: str, mark: str | None) -> None:
        """Remember that the run is sound; without a fingerprint, do nothing."""
        if mark is not None:
            self._known[key] = mark
            self._changed = True

    def save(self) -> None:
        """Write the file if possible; additions of other processes meanwhile are lost."""
        if not self._changed:
            return
        with contextlib.suppress(OSError):
            data = json.dumps(self._known, indent=0).encode()
            write_atomically(self._path, data, sync=False)  # its loss only costs time
            self._changed = False
