"""glibc's allocator: a training loop keeps freed memory, a driver gives it back."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Mapping

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
# Activations are smaller. Whole batches are larger and go back to the system: kept as well, they
# had a MUSIC-u run grow by 40 MB per thousand steps, as its heap fell into ever smaller pieces.
_KEPT_BLOCK = 2 * 2**20
_KEPT = 128 * 2**20


def keep_freed_memory() -> bool:
    """Has up to 128 MiB of freed memory kept by this process instead of given back.

    By default glibc returns the buffers of every activation to the system and faults them in
    again, page by page: a fifth of a gradient update of 3 x 256 networks.

    Returns:
        Whether the allocator took it; other C libraries have no such setting.
    """
    return _set({_M_MMAP_THRESHOLD: _KEPT_BLOCK, _M_TRIM_THRESHOLD: _KEPT})


def give_back_freed_memory() -> bool:
    """Has this process, which runs for days beside others, give back what it frees.

    By default each of a driver's thirty threads has a heap of its own, and glibc puts ever larger
    blocks into it once one of that size was freed. A picture of a megabyte then leaves a hole that
    small things fall into: 0.5 MB a trial of a search.

    Returns:
        Whether the allocator took it.
    """
    return _set({_M_ARENA_MAX: 2, _M_MMAP_THRESHOLD: 128 * 2**10, _M_TRIM_THRESHOLD: 128 * 2**10})


def _set(options: Mapping[int, int]) -> bool:
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return all(mallopt(option, value) == 1 for option, value in options.items())
