"""Functions compiled by numba, where a CPU would else wait for Python or PyTorch between steps."""

from __future__ import annotations

import hashlib
import inspect
import logging
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

logger = logging.getLogger(__name__)

Function = Callable[..., Any]


def compiled(function: Function, *, any_order: bool = False) -> Any:
    """A function that other compiled ones call.

    Args:
        any_order: its sums may be taken in any order, the same one in every run: else they are not
            vectorised. NaN stays NaN.
    """
    fastmath = {"reassoc", "contract", "nsz"} if any_order else False
    return njit(function, error_model="numpy", fastmath=fastmath)


def kept_on_disk(function: Function) -> Any:
    """One that Python calls. Others may run meanwhile; what it is compiled to is kept.

    It lies beside the source, or in the user's cache, or in `NUMBA_CACHE_DIR`, until the source
    changes; where none can be written, each process compiles it anew.
    """
    dispatcher: Any = njit(function, nogil=True, error_model="numpy")
    try:
        dispatcher._cache = _Cache(function)  # type: ignore[no-untyped-call]
    except (RuntimeError, OSError) as error:
        logger.warning(
            "compiled code is not kept, so that each run takes longer to start: %s", error
        )
    return dispatcher


def is_kept(function: Any) -> bool:
    """Whether what `kept_on_disk` has made lies there already, compiled by an earlier process."""
    cache = function._cache
    if not isinstance(cache, _Cache):
        return False
    return any(Path(cache.cache_path).glob(f"{cache._impl.filename_base}.nbi"))


def sources_of(*modules: ModuleType) -> str:
    """Changes with any of their files.

    What a function encloses decides, beside its own file, whether what was kept of it still holds.
    """
    files = (Path(inspect.getfile(module)).read_bytes() for module in modules)
    return hashlib.sha256(b"".join(files)).hexdigest()


class _Cache(FunctionCache):
    """Numba's own, without which a process goes on all the same."""

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            logger.warning("compiled code could not be kept: %s", error)
