"""Compilation by numba, for loops in which Python's or PyTorch's overhead dominates."""

from __future__ import annotations

import hashlib
import inspect
import logging
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from filelock import FileLock, Timeout
from numba import njit
from numba.core.caching import FunctionCache
from numba.extending import register_jitable

logger = logging.getLogger(__name__)

Function = Callable[..., Any]

PATIENCE = 120.0
"""Longest wait in seconds for another process's machine code, which takes about 20 s."""


def compiled(function: Function, *, any_order: bool = False) -> Any:
    """Make a function callable from compiled functions. Python calls it uncompiled.

    Args:
        any_order: let the compiler reorder sums, which vectorizes them. The order is the same in
            every run, and NaN stays NaN.
    """
    fastmath = {"reassoc", "contract", "nsz"} if any_order else False
    # Without wrappers for calls from C: a third of the compilation time.
    options = {"error_model": "numpy", "fastmath": fastmath, "no_cfunc_wrapper": True}
    return register_jitable(**options)(function)


def kept_on_disk(function: Function) -> Any:
    """Compile a function that Python calls, without the GIL, and cache the machine code on disk.

    The cache is beside the source, in the user's cache folder or in `NUMBA_CACHE_DIR`, and is valid
    until the source changes. If none of them is writable, each process compiles the function.
    """
    dispatcher: Any = njit(function, nogil=True, error_model="numpy")
    try:
        dispatcher._cache = _Cache(function)
    except (RuntimeError, OSError) as error:
        logger.warning(
            "compiled code cannot be cached, so each run takes longer to start: %s", error
        )
    return dispatcher


def is_kept(function: Any) -> bool:
    """Whether the machine code of a `kept_on_disk` function is cached."""
    cache = function._cache
    if not isinstance(cache, _Cache):
        return False
    return any(Path(cache.cache_path).glob(f"{cache._impl.filename_base}.nbi"))


def sources_of(*modules: ModuleType) -> str:
    """Hash of the modules' files.

    A function that encloses it is compiled again if one of them changes, not only its own file.
    """
    files = (Path(inspect.getfile(module)).read_bytes() for module in modules)
    return hashlib.sha256(b"".join(files)).hexdigest()


class _Cache(FunctionCache):
    """Numba's cache: one process compiles while others wait; write errors become warnings."""

    def __init__(self, function: Function) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        name = f"{self._impl.filename_base}.lock"
        self._lock = FileLock(Path(self.cache_path, name), timeout=PATIENCE)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The cached code. None: the caller holds the lock, compiles and saves."""
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is None and self._acquire():
            found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if found is not None:
                self._lock.release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            logger.warning("compiled code could not be cached: %s", error)
        finally:
            self._lock.release()

    def _acquire(self) -> bool:
        """Acquire the lock; False if that fails or takes too long, which only costs time."""
        try:
            self._lock.acquire()
        except (OSError, NotImplementedError, Timeout):
            return False
        return True
