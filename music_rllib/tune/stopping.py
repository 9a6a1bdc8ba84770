"""Signals: the first saves the runs and stops the sweep, the second stops it at once."""

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
from music_rllib.runtime.process import SIGNALS, early, end_process, handle_signals
from music_rllib.runtime.ray_cluster import RayWatch
from music_rllib.training.job import StopFlag
from music_rllib.training.worker import STOPPED

WATCH_SECONDS = 0.3
GROUP_SECONDS = 3.0
"""Wait after a local Ray has ended: the signal that ended it may still reach this process."""


class StopSignals(tune.Callback):
    """Ctrl-C and SIGTERM end Tune's loop after every run has saved its state.

    Saving takes one training iteration, a few seconds. After the grace time the loop ends anyway,
    and unsaved steps are computed again later. The same holds if a local Ray gets the signal too:
    `timeout` and Slurm signal a whole process group.

    If Ray dies, the process ends with exit code 1, because the main thread could wait for Ray for
    a minute, or forever.

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
            on_ray_gone: Called, in a thread, before the process ends because Ray has ended: with
                the cause, or None if the signal ended Ray too.
        """
        self.received: int | None = None
        self.flag = StopFlag(f"stop-{uuid.uuid4().hex}")
        self._on_stop = on_stop
        self._grace = grace_seconds
        self._on_ray_gone = on_ray_gone
        self._asked_at = 0.0
        self._running: set[str] = set()
        """Trials that have to save their state."""
        self._handlers_before: dict[int, Any] = {}
        self._end_loop: Callable[[], None] | None = None
        self._left = threading.Event()

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            # After `ray.init`, which sets its own handlers.
            early.install()
            early.check()
            self._handlers_before = {number: signal.getsignal(number) for number in SIGNALS}
            handle_signals(self._stop)
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
        """Keep Tune's new handler of SIGINT, which ends its loop, for later."""
        if not self._handlers_before:
            return
        tunes_handler = signal.getsignal(signal.SIGINT)

        def end_loop() -> None:
            if callable(tunes_handler):
                tunes_handler(signal.SIGINT, None)
            handle_signals(self._stop_at_once)  # Tune has restored the earlier ones

        self._end_loop = end_loop
        handle_signals(self._stop)
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
        """End Tune's loop when every run is saved, or after the grace time."""
        if self.received is None or self._end_loop is None:
            return
        if not self._running or time.monotonic() - self._asked_at >= self._grace:
            end_loop, self._end_loop = self._end_loop, None
            end_loop()

    # -- signals --------------------------------------------------------------------------

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.received, self._asked_at = number, time.monotonic()
        handle_signals(self._stop_at_once)
        # In a thread: the main thread may be in a call of Ray.
        threading.Thread(target=self._tell_workers, daemon=True).start()
        self._on_stop()

    def _tell_workers(self) -> None:
        with contextlib.suppress(Exception):
            self.flag.set()

    def _watch_ray(self) -> None:
        """End the process when Ray ends, because a thread that waits for Ray never returns."""
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
