"""Signals: the first lets runs save their state and ends the sweep, the second ends it at once."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
import uuid
from collections.abc import Callable
from types import FrameType
from typing import Any

from ray import tune
from ray.tune.experiment import Trial

from music_rllib.command_line import say_stopped_at_once
from music_rllib.errors import FAILED
from music_rllib.runtime.process import SIGNALS, early, end_process
from music_rllib.runtime.ray_cluster import RayWatch
from music_rllib.training.job import StopFlag
from music_rllib.training.worker import STOPPED

WATCH_SECONDS = 0.3
GROUP_SECONDS = 3.0
"""After a local Ray has died, a signal that ended it may still be on its way to this process."""


class StopSignals(tune.Callback):
    """Ctrl-C and SIGTERM end Tune's loop in good order: when every run has saved its state.

    That takes as long as a round of training, some seconds at most; after the grace time the loop
    ends in any case, and what has not been saved is computed again later. The same happens where a
    local Ray gets the signal too, as from `timeout` and Slurm, which signal a whole process group.

    A Ray that has died ends the process as well, with exit code 1: the main thread may be waiting
    for it, which Ray lets it do for a minute, or for good.

    Tune calls it with keywords only.
    """

    def __init__(
        self,
        on_stop: Callable[[], None],
        grace_seconds: float,
        on_ray_gone: Callable[[str | None], None],
    ) -> None:
        """Handle signals until the end of the `with`.

        Args:
            on_stop: Called at the first signal.
            grace_seconds: How long runs may take to save their state.
            on_ray_gone: Called, in a thread, before the process ends because its Ray has ended:
                with the cause, or None where that was told to stop as well.
        """
        self.received: int | None = None
        self.flag = StopFlag(f"stop-{uuid.uuid4().hex}")
        self._on_stop = on_stop
        self._grace = grace_seconds
        self._on_ray_gone = on_ray_gone
        self._asked_at = 0.0
        self._running: set[str] = set()
        """Trials with something to save."""
        self._handlers_before: dict[int, Any] = {}
        self._end_loop: Callable[[], None] | None = None
        self._left = threading.Event()

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            # After `ray.init`, which sets handlers of its own.
            early.install()
            early.check()
            self._handlers_before = {number: signal.getsignal(number) for number in SIGNALS}
        threading.Thread(target=self._watch_ray, name="ray-watch", daemon=True).start()

    def __exit__(self, *_: object) -> None:
        self._left.set()
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)
        if self.received is not None:
            with contextlib.suppress(Exception):
                self.flag.clear()

    # -- Tune's callbacks -----------------------------------------------------------------

    def setup(self, **_: Any) -> None:
        """Tune has just set its handler of SIGINT, which ends its loop: keep it for later."""
        if not self._handlers_before:
            return
        tunes_handler = signal.getsignal(signal.SIGINT)

        def end_loop() -> None:
            if callable(tunes_handler):
                tunes_handler(signal.SIGINT, None)
            for number in SIGNALS:  # Tune has set the one that was there before
                signal.signal(number, self._stop_at_once)

        self._end_loop = end_loop
        for number in SIGNALS:
            signal.signal(number, self._stop)
        if early.received is not None:
            self._stop(early.received, None)

    def on_trial_start(self, *, trial: Trial, **_: Any) -> None:
        self._running.add(trial.trial_id)

    def on_trial_result(self, *, trial: Trial, result: dict[str, Any], **_: Any) -> None:
        if result.get(STOPPED):
            self._running.discard(trial.trial_id)

    def on_trial_complete(self, *, trial: Trial, **_: Any) -> None:
        self._running.discard(trial.trial_id)

    on_trial_error = on_trial_recover = on_trial_complete

    def on_step_end(self, **_: Any) -> None:
        """End Tune's loop, which went round once, where everything is saved or time is up."""
        if self.received is None or self._end_loop is None:
            return
        if not self._running or time.monotonic() - self._asked_at >= self._grace:
            end_loop, self._end_loop = self._end_loop, None
            end_loop()

    # -- signals --------------------------------------------------------------------------

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.received, self._asked_at = number, time.monotonic()
        for each in SIGNALS:
            signal.signal(each, self._stop_at_once)
        # Not in here: the main thread may be in the middle of talking to Ray.
        threading.Thread(target=self._tell_workers, daemon=True).start()
        self._on_stop()

    def _tell_workers(self) -> None:
        with contextlib.suppress(Exception):
            self.flag.set()

    def _watch_ray(self) -> None:
        """End the process when Ray ends: whoever waits for it waits for good, or is aborted."""
        watch = RayWatch()
        while not self._left.wait(WATCH_SECONDS):
            if (cause := watch.look()) is None:
                continue
            if self.received is None and self._left.wait(GROUP_SECONDS):
                return
            stopped_by = self.received
            self._on_ray_gone(None if stopped_by is not None else cause)
            end_process(FAILED if stopped_by is None else 128 + stopped_by)

    def _stop_at_once(self, number: int, frame: FrameType | None) -> None:
        say_stopped_at_once()
        end_process(128 + number)
