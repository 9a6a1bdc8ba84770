"""Files on a disk that survive a crash or a power cut."""

from __future__ import annotations

import contextlib
import errno
import os
import uuid
from pathlib import Path

_NO_FSYNC = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EBADF}
"""Errors of file systems that cannot flush a folder, such as some of SMB and FUSE."""


def write_atomically(path: Path, data: bytes, *, sync: bool = True) -> None:
    """Replace the content of `path`; a crash leaves either the old content or the new one.

    The umask decides who may read the file. Without `sync`, a power cut may lose the content.

    Raises:
        OSError: The file cannot be written; the message names the path.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    if sync:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, so that a rename in it survives a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_FSYNC:
            raise
    finally:
        os.close(handle)
