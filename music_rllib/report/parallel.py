"""The same work on many items, on as many CPUs as there are."""

from __future__ import annotations

import multiprocessing
import os
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

__all__ = ["forked_map"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def forked_map(
    do: Callable[[_Item], _Result], items: Sequence[_Item], *, few: int
) -> list[_Result]:
    """`do` of each item, in their order.

    Args:
        do: may be any function; it must not depend on what it did to other items.
        items: may be anything; results must be picklable.
        few: up to so many items, more processes would cost more than they save.
    """
    global _WORK
    processes = min(len(os.sched_getaffinity(0)), len(items))
    # What can't be sent to another process is there in a fork of this one, and a fork is safe only
    # without threads.
    if len(items) <= few or processes == 1 or threading.active_count() > 1:
        return [do(item) for item in items]
    _WORK = (do, items)
    chunk = max(1, len(items) // (8 * processes))
    with warnings.catch_warnings():
        # Python 3.12 counts the idle threads of numerical libraries.
        warnings.simplefilter("ignore", DeprecationWarning)
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            return pool.map(_do_one, range(len(items)), chunksize=chunk)


_WORK: tuple[Callable[[Any], Any], Sequence[Any]] = (len, ())


def _do_one(position: int) -> Any:
    do, items = _WORK
    return do(items[position])
