"""The thread that sends queued records to MLflow while the sweep runs."""

from __future__ import annotations

import logging
import math
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from threading import Thread

from music_rllib.store.storage import DamagedError
from music_rllib.tracking.client import is_lasting, is_unclear, mlflow_reason
from music_rllib.tracking.run_queue import RunQueue

logger = logging.getLogger(__name__)

SAY_SECONDS = 5.0
"""Time between two messages about the records that are left."""
GATHER_SECONDS = 0.2
"""Wait before each round, so that one request takes several reports."""
UNCLEAR_SECONDS, LONGEST_UNCLEAR_SECONDS = 10.0, 120.0
"""Time of unclear failures after which a run is refused, if others succeed meanwhile or not."""
FIRST_PAUSE = 0.5
LONGEST_PAUSE = 30.0


@dataclass(frozen=True, kw_only=True)
class Pending:
    """Number of records that MLflow does not have yet."""

    records: int
    error: str | None
    """Reason of the last failure; None if the last round succeeded."""

    def __bool__(self) -> bool:
        return self.records > 0


class Sender(Thread):
    """Sends the records of each run in order, and retries with growing pauses after a failure.

    A failure that may pass (server down or busy, disk full) ends the round, and its run moves to
    the end of the list, so that one bad run does not block the others. After a lasting failure
    (a refused value, a deleted run, a damaged node) the run is not sent until the sweep is started
    again. A run that has ended and is delivered is dropped, so the cost of a round depends only on
    the active runs. A run is sent after the run that it starts from, whose id it has as a tag.
    """

    def __init__(self, store: str, at_once: int = 1) -> None:
        """Send to `store`, its public URI for messages, with `at_once` requests at a time."""
        super().__init__(name="mlflow-sender", daemon=True)
        self._store, self._at_once = store, at_once
        self._runs: dict[RunQueue, None] = {}
        self._change = threading.Condition()
        self._has_news = self._flushing = self._stopped = self._failed = False
        self._failures = 0
        self._delayed: set[RunQueue] = set()
        """Runs whose last attempt failed; they come last."""
        self._succeeded = -math.inf
        """Time of the last success."""
        self._error: str | None = None

    def add(self, run: RunQueue) -> None:
        """Wake the thread; call this after adding something to a run's queue."""
        with self._change:
            self._runs.setdefault(run)
            self._has_news = True
            self._change.notify_all()

    def pending(self) -> Pending:
        """The number of records that MLflow does not have yet, and why."""
        with self._change:
            runs = list(self._runs)
        refused = [run.refused for run in runs if run.refused]
        return Pending(
            records=sum(run.records for run in runs),
            error=self._error or (refused[0] if refused else None),
        )

    def flush(self, timeout: float, say: Callable[[int], None] | None = None) -> bool:
        """Wait for delivery; returns whether everything is delivered.

        Args:
            timeout: Seconds after which to stop; with `say`, seconds without any progress.
            say: Receives the number of records that are left, while there is progress.
        """
        left, patience = self.pending().records, timeout
        with self._change:
            self._flushing = self._has_news = True
            self._change.notify_all()
            while patience > 0 and not self._change.wait_for(
                lambda: not any(run.records and not run.refused for run in self._runs),
                min(patience, SAY_SECONDS),
            ):
                before, left = left, sum(run.records for run in self._runs)
                if say is not None and left < before:
                    patience = timeout
                    say(left)
                else:
                    patience -= SAY_SECONDS
            self._flushing = False
        return not self.pending()

    def stop(self) -> None:
        """End the thread after the run that it is sending."""
        with self._change:
            self._stopped = True
            self._change.notify_all()

    def run(self) -> None:
        while self._wait_for_news():
            succeeded = self._send_round()
            with self._change:
                self._has_news = self._has_news or not succeeded
                self._change.notify_all()
            if not succeeded:
                self._pause()

    def _wait_for_news(self) -> bool:
        """Wait until there is something to send; False when stopped."""
        with self._change:
            self._change.wait_for(lambda: self._has_news or self._stopped)
            self._change.wait_for(lambda: self._flushing or self._stopped, GATHER_SECONDS)
            self._has_news = False
            return not self._stopped

    def _send_round(self) -> bool:
        """Send everything in the queues; False if a failure ended the round."""
        with self._change:
            runs = [run for run in self._runs if run.refused is None]
        # Metrics of running runs before those of finished ones, and policies at last.
        runs.sort(key=lambda run: (run in self._delayed, not run.is_running))
        self._failed = False
        for policies in (False, True):
            left = runs
            while left and not self._failed:
                unsent = {run.node_key for run in left}
                self._send_each([run for run in left if run.source not in unsent], policies)
                left = [run for run in left if run.source in unsent]
        if self._failed or self._stopped:
            return False
        if self._error is not None:
            logger.warning("MLflow at %s accepts records again", self._store)
        self._failures, self._error = 0, None
        # `add` is called after a run's queue has grown: either that is seen here, or `add` runs
        # after this and adds the run again.
        with self._change:
            self._runs = {run: None for run in self._runs if run.records or run.is_running}
        return True

    def _send_each(self, runs: Iterable[RunQueue], policies: bool) -> None:
        """Send to several runs at once; no more after a failure."""
        waiting = (run for run in runs if run.records and run.refused is None)
        left = deque(run for run in waiting if not (policies and run.is_running))

        def send() -> None:
            while not (self._failed or self._stopped):
                try:
                    run = left.popleft()
                except IndexError:
                    return
                self._send_run(run, policies)
                # The next round sends the new metrics. Each round sends a policy, as there may
                # always be new metrics, and a run is kept in memory until its policy is sent.
                if policies and self._has_news:
                    return

        threads = [Thread(target=send, daemon=True) for _ in range(min(self._at_once, len(left)))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _send_run(self, run: RunQueue, policies: bool) -> None:
        try:
            run.send(policy=policies)
        # The thread must survive every error; unsent records stay in the queue.
        except Exception as error:
            reason = mlflow_reason(error)
            lasts = is_lasting(error) or isinstance(error, DamagedError)
            if lasts or (is_unclear(error) and self._has_lasted(run)):
                run.refused = reason
                logger.warning("MLflow at %s does not get all of a run: %s", self._store, reason)
                return
            with self._change:
                if self._error is None:
                    logger.warning(
                        "MLflow at %s does not accept records, they wait: %s", self._store, reason
                    )
                self._failures, self._error = self._failures + (not self._failed), reason
                self._failed = True
                self._delayed.add(run)
                self._runs[run] = self._runs.pop(run)
        else:
            self._delayed.discard(run)
            run.unclear_since, self._succeeded = None, time.monotonic()

    def _has_lasted(self, run: RunQueue) -> bool:
        """Whether an unclear failure of the run is a lasting one."""
        now = time.monotonic()
        if run.unclear_since is None:
            run.unclear_since = now
        elapsed = now - run.unclear_since
        # Of this run alone, or of the server.
        least = UNCLEAR_SECONDS if self._succeeded > run.unclear_since else LONGEST_UNCLEAR_SECONDS
        return elapsed >= least

    def _pause(self) -> None:
        longest = FIRST_PAUSE if self._flushing else LONGEST_PAUSE
        seconds = min(longest, FIRST_PAUSE * 2 ** min(self._failures - 1, 10))
        seconds *= random.uniform(0.5, 1.0)
        with self._change:
            was_flushing = self._flushing
            self._change.wait_for(lambda: self._stopped or self._flushing > was_flushing, seconds)
