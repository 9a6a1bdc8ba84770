"""The thread that sends queued records to MLflow while the sweep runs."""

from __future__ import annotations

import logging
import random
import threading
from dataclasses import dataclass

from music_rllib.store.storage import DamagedError
from music_rllib.tracking.client import is_lasting, mlflow_reason
from music_rllib.tracking.run_queue import RunQueue

logger = logging.getLogger(__name__)

GATHER_SECONDS = 0.2
"""Wait before each round, so that one request takes several reports."""
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


class Sender(threading.Thread):
    """Sends the records of each run in order, and retries with growing pauses after a failure.

    A failure that may pass (server down or busy, disk full) ends the round, and its run moves to
    the end of the list, so that one bad run does not block the others. After a lasting failure
    (a refused value, a deleted run, a damaged node) the run is not sent until the sweep is started
    again. A run that has ended and is delivered is dropped, so the cost of a round depends only on
    the active runs. `store` is the public URI of MLflow's store, for messages.
    """

    def __init__(self, store: str) -> None:
        super().__init__(name="mlflow-sender", daemon=True)
        self._store = store
        self._runs: dict[RunQueue, None] = {}
        self._change = threading.Condition()
        self._has_news = self._flushing = self._stopped = False
        self._failures = 0
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

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery; returns whether everything is delivered."""
        with self._change:
            self._flushing = self._has_news = True
            self._change.notify_all()
            self._change.wait_for(
                lambda: not any(run.records and not run.refused for run in self._runs), timeout
            )
            self._flushing = False
        return not self.pending()

    def stop(self) -> None:
        """End the thread after the current request."""
        with self._change:
            self._stopped = True
            for run in self._runs:
                run.cancel()
            self._change.notify_all()

    def run(self) -> None:
        """Send in rounds until stopped."""
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
        # Metrics of running runs before policies of finished ones.
        for run in sorted(runs, key=lambda run: not run.is_running):
            if self._stopped or not self._send_run(run):
                return False
        if self._error is not None:
            logger.warning("MLflow at %s accepts records again", self._store)
        self._failures, self._error = 0, None
        # `add` is called after a run's queue has grown: either that is seen here, or `add` runs
        # after this and adds the run again.
        with self._change:
            self._runs = {run: None for run in self._runs if run.records or run.is_running}
        return True

    def _send_run(self, run: RunQueue) -> bool:
        try:
            run.send()
        # The thread must survive every error; unsent records stay in the queue.
        except Exception as error:
            reason = mlflow_reason(error)
            if is_lasting(error) or isinstance(error, DamagedError):
                run.refused = reason
                logger.warning("MLflow at %s does not get all of a run: %s", self._store, reason)
                return True
            if self._error is None:
                logger.warning(
                    "MLflow at %s does not accept records, they wait: %s", self._store, reason
                )
            self._failures, self._error = self._failures + 1, reason
            with self._change:
                self._runs[run] = self._runs.pop(run)
            return False
        return True

    def _pause(self) -> None:
        longest = FIRST_PAUSE if self._flushing else LONGEST_PAUSE
        seconds = min(longest, FIRST_PAUSE * 2 ** min(self._failures - 1, 10))
        seconds *= random.uniform(0.5, 1.0)
        with self._change:
            was_flushing = self._flushing
            self._change.wait_for(lambda: self._stopped or self._flushing > was_flushing, seconds)
