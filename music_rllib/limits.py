"""Limits on files from outside, and functions that read within them.

Policies, object folders, exported sweeps and YAML can come from strangers. Input beyond a limit is
rejected before it costs time or memory. Each limit is far above what a sweep writes.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import re
import stat
from pathlib import Path
from typing import Any, BinaryIO

MOST_JSON_BYTES = 8 << 20
"""Largest JSON file: a manifest, a handoff's description, an export's header, a search."""
MOST_YAML_BYTES = 256 << 10
"""Largest YAML file: a sweep, or the configuration in an export."""
MOST_WEIGHTS_BYTES = 1 << 30
"""Largest file of one module's weights, or of a policy."""
MOST_SAFETENSORS_HEADER_BYTES = 1 << 20
MOST_NESTED = 64
"""Depth of nested lists and mappings."""
MOST_CONTAINERS = 200_000
"""Lists and mappings in a JSON document."""
MOST_YAML_VALUES = 12_000
"""Values in a YAML document; the values of an alias count at each of its uses."""
MOST_DIGITS = 100
"""Digits of an integer: the state of a random generator has 39."""
MOST_INDICES = 10_000
"""Indices of an observation that a task can list."""
MOST_SEEDS = 10_000
MOST_GRID_POINTS = 10_000
"""Points of a stage's grid."""
MOST_RUNS = 100_000
"""Runs of a sweep."""
MOST_TABLE_ROWS = 50_000_000
"""Rows of an exported table."""
MOST_ROWS_PER_BYTE = 4
"""Rows of an exported table per byte, after its first 100,000: real runs have 0.1 to 0.3."""
MOST_TABLE_TEXT = 64 << 20
"""Characters in all cells of an exported table."""
MOST_UNPACKED_BYTES = 32 << 20
"""Size of an unpacked Parquet table, beside `MOST_UNPACKED_PER_BYTE`."""
MOST_UNPACKED_PER_BYTE = 16
"""Unpacked bytes for each byte of the file: real sweeps have 1.5 to 1.8."""
MOST_COLUMNS = 10_000
"""Columns of an exported table."""

# A string without an end extends to the end: a new search at each quote takes quadratic time.
_TEXTS = re.compile(rb'"(?:[^"\\]++|\\.)*+"?', re.DOTALL)
_LONG_NUMBER = re.compile(rb"\d{%d}" % (MOST_DIGITS + 1))
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))


def open_regular(path: Path | str, *, follow: bool = False) -> BinaryIO:
    """Open a regular file for reading; other kinds of files can block or have no end.

    Args:
        path: The file.
        follow: Whether `path` itself can be a link. Set it for a path that a user names, not for
            the files in a folder from elsewhere.

    Raises:
        OSError: It is a link, FIFO, device, socket or folder, or can't be read.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        handle = os.open(path, flags)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link; a FIFO or socket
            raise OSError(error.errno, "it is not a regular file", str(path)) from None
        raise
    kind = stat.S_IFMT(os.fstat(handle).st_mode)
    if kind != stat.S_IFREG:
        os.close(handle)
        if kind == stat.S_IFDIR:
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return os.fdopen(handle, "rb")


def read_regular(path: Path | str, most: int, *, follow: bool = False) -> bytes:
    """The content of a regular file of at most `most` bytes.

    Raises:
        OSError: It is longer, or `open_regular` rejects it.
    """
    with open_regular(path, follow=follow) as file:
        size = os.fstat(file.fileno()).st_size
        # It can grow while it is read.
        data = b"" if size > most else file.read(most + 1)
        if (size := max(size, len(data))) > most:
            raise OSError(errno.EFBIG, f"it has {size} bytes, more than {most}", str(path))
    return data


def read_json(data: bytes | str) -> Any:
    """Parse JSON that can be hostile.

    Raises:
        ValueError: It is not JSON, or beyond a limit, which the message names.
    """
    raw = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
    if len(raw) > MOST_JSON_BYTES:
        raise ValueError(f"must have at most {MOST_JSON_BYTES} bytes, it has {len(raw)}")
    bare = _TEXTS.sub(b"", raw)
    if match := _LONG_NUMBER.search(bare):
        number = f"{match[0][:8].decode()}..."
        raise ValueError(f"a number must have at most {MOST_DIGITS} digits, got {number}")
    brackets = bare.translate(None, _NO_BRACKETS)
    if len(brackets) > 2 * MOST_CONTAINERS:
        raise ValueError(
            f"must have at most {MOST_CONTAINERS} lists and mappings, it has {len(brackets) // 2}"
        )
    depths = itertools.accumulate(1 if bracket in b"[{" else -1 for bracket in brackets)
    if max(depths, default=0) > MOST_NESTED:
        raise ValueError(f"must be nested at most {MOST_NESTED} levels deep, it is deeper")
    try:
        value = json.loads(raw)
        if _SURROGATE.search(raw):
            json.dumps(value, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("must be nested less deeply") from None
    return value


def check_safetensors(data: bytes) -> None:
    """Check the size of a safetensors file's header, in its first 8 bytes, before it is parsed.

    Raises:
        ValueError: It is too large.
    """
    size = int.from_bytes(data[:8], "little")
    if size > MOST_SAFETENSORS_HEADER_BYTES:
        raise ValueError(
            f"its header must have at most {MOST_SAFETENSORS_HEADER_BYTES} bytes, it says {size}"
        )
