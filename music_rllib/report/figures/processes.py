"""Worker processes that draw a report's figures."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver

_PRELOADED = (
    "joblib.externals.cloudpickle",
    "matplotlib.backends.backend_pdf",
    "matplotlib.backends.backend_svg",
    "music_rllib.report.figures.draw",
)


@contextmanager
def drawing_processes() -> Iterator[Executor | None]:
    """A process for each core; None for a single core, or if no process can be started.

    They are forks of one server, which loads their modules once, in the background.
    """
    cores = len(os.sched_getaffinity(0))
    if cores == 1:
        yield None
        return
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*_PRELOADED])
    try:
        forkserver.ensure_running()
    except OSError:
        yield None
        return
    with ProcessPoolExecutor(cores, context, _leave_interrupts_to_the_caller) as processes:
        yield processes


def _leave_interrupts_to_the_caller() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
