"""Processes that read a report's values and draw its figures while the rest is computed."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver

__all__ = ["drawing_processes"]

_LOADED = (
    "joblib.externals.cloudpickle",
    "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_svg",
    "music_rllib.report.figures.draw",
    "music_rllib.results.from_mlflow",
    "sqlalchemy",
)


@contextmanager
def drawing_processes() -> Iterator[Executor | None]:
    """As many as there are cores; none for a single one, or where none can be started.

    What they need is loaded in the background from now on, once: all are copies of one process.
    """
    cores = len(os.sched_getaffinity(0))
    if cores == 1:
        yield None
        return
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_LOADED])
    try:
        forkserver.ensure_running()
    except OSError:
        yield None
        return
    with ProcessPoolExecutor(cores, context, _leave_interrupts_to_the_caller) as processes:
        yield processes


def _leave_interrupts_to_the_caller() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
