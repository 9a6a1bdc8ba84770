"""This process: signals during set-up, imports, ending when a library hangs, and memory use."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def handle_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    """Call `handler` for Ctrl-C and SIGTERM."""
    for number in SIGNALS:
        signal.signal(number, handler)


class EarlySignals:
    """Handle Ctrl-C and SIGTERM while a sweep is being set up.

    A signal raises KeyboardInterrupt, and is remembered in case a library swallows the exception.
    A second signal ends the process.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> EarlySignals:
        self.received = None
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
            self.install()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def install(self) -> None:
        """Set the handlers, also after a library has replaced them."""
        if self._before:
            handle_signals(self._handle)

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self.received is not None:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            from music_rllib.command_line import say_stopped_at_once  # not in workers

            say_stopped_at_once()
            os._exit(128 + number)
        self.received = number
        raise KeyboardInterrupt


early = EarlySignals()
"""The handlers of this process, which drives at most one sweep."""


@contextlib.contextmanager
def without_collections() -> Iterator[None]:
    """Import libraries without garbage collections, which take a sixth of the time of an import."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def try_for(seconds: float, *steps: Callable[[], object]) -> None:
    """Run all steps in a thread, ignore their exceptions, and wait at most `seconds`."""

    def run() -> None:
        for step in steps:
            with contextlib.suppress(Exception):
                step()

    thread = threading.Thread(target=run, name="last-steps", daemon=True)
    thread.start()
    thread.join(seconds)


def end_process(code: int) -> NoReturn:
    """End this process without clean-up; a sweep survives that, and a local Ray ends as well."""
    show_cursor = b"\x1b[?25h\n" if sys.stdout.isatty() else b""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        os.write(sys.stdout.fileno(), show_cursor)
    os._exit(code)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
# Activations are smaller. Larger blocks are returned to the system: keeping whole batches
# fragmented the heap, and a MUSIC-u run grew by 40 MB per 1,000 steps.
_KEPT_BLOCK = 2 * 2**20
_KEPT = 128 * 2**20


def keep_freed_memory() -> bool:
    """Let this process keep up to 128 MiB of freed memory.

    By default glibc returns the memory of every activation to the system and requests it again,
    which takes 20% of a gradient update of 3 x 256 networks.

    Returns:
        Whether the C library has these settings.
    """
    return _set_allocator({_M_MMAP_THRESHOLD: _KEPT_BLOCK, _M_TRIM_THRESHOLD: _KEPT})


def give_back_freed_memory() -> bool:
    """Let this process return freed memory to the system, as it runs for days beside others.

    By default each of a driver's thirty threads has its own heap, which large freed blocks
    fragment: 0.5 MB per trial of a search.

    Returns:
        Whether the C library has these settings.
    """
    return _set_allocator(
        {_M_ARENA_MAX: 2, _M_MMAP_THRESHOLD: 128 * 2**10, _M_TRIM_THRESHOLD: 128 * 2**10}
    )


def _set_allocator(options: Mapping[int, int]) -> bool:
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not glibc
        return False
    return all(mallopt(option, value) == 1 for option, value in options.items())


def use_reproducible_gpu_kernels() -> None:
    """Choose a GPU's reproducible kernels; RLlib does so only where PyTorch has no CUDA.

    PyTorch prints a warning if a user's intrinsic reward needs an operation that has none.
    """
    import torch

    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read with the first product
    torch.set_deterministic_debug_mode("warn")
    # Else each new tensor is filled by another kernel.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
