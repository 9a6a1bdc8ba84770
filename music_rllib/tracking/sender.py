"""The thread that sends queued events and artefacts to MLflow while the sweep runs."""

from __future__ import annotations

import logging
import random
import threading
from dataclasses import dataclass

from music_rllib.store.object_folder import DamagedError
from music_rllib.tracking.mlflow_client import is_lasting, mlflow_reason
from music_rllib.tracking.projection import RunProjection

logger = logging.getLogger(__name__)

GATHER_SECONDS = 0.2
"""Wait before each round, so that one request takes several reports."""
FIRST_PAUSE = 0.5
LONGEST_PAUSE = 30.0


@dataclass(frozen=True, kw_only=True)
class Pending:
    """Counts of what MLflow does not have yet."""

    records: int
    artefacts: int
    error: str | None
    """Reason of the last failure; None if the last round succeeded."""

    def __bool__(self) -> bool:
        return self.records > 0 or self.artefacts > 0


@dataclass(eq=False)
class _Lane:
    """Either the records or the artefacts of a run; neither waits for the other."""

    run: RunProjection
    has_artefacts: bool
    refused: str | None = None
    """Reason of a lasting failure, after which nothing more is sent."""

    @property
    def is_waiting(self) -> bool:
        """Whether there is anything to send that was not refused."""
        size = self.run.artefacts if self.has_artefacts else self.run.records
        return self.refused is None and size > 0

    def send(self) -> None:
        if self.has_artefacts:
            self.run.send_artefacts()
        else:
            self.run.send_records()


class Sender(threading.Thread):
    """Sends the records of each run in order, and retries with growing pauses after a failure.

    A failure that may pass (server down or busy, disk full) ends the round, and its lane moves to
    the end of the queue, so that one bad run does not block the others. After a lasting failure
    (a refused value, a deleted run, a damaged node) the lane stops until the sweep is started
    again. A run that has ended and is delivered is dropped, so the cost of a round depends only on
    the runs under way. `store` is the public URI of MLflow's store, for messages.
    """

    def __init__(self, store: str) -> None:
        super().__init__(name="mlflow-sender", daemon=True)
        self._store = store
        self._runs: set[RunProjection] = set()
        self._lanes: list[_Lane] = []
        self._change = threading.Condition()
        self._has_news = self._hurry = self._stopped = False
        self._failures = 0
        self._error: str | None = None

    def add(self, run: RunProjection) -> None:
        """Wake the thread; call this after adding something to a run's queue."""
        with self._change:
            if run not in self._runs:
                self._runs.add(run)
                self._lanes += [_Lane(run, has_artefacts=False), _Lane(run, has_artefacts=True)]
            self._has_news = True
            self._change.notify_all()

    def pending(self) -> Pending:
        """What MLflow does not have yet, and why."""
        with self._change:
            runs = list(self._runs)
            refused = [lane.refused for lane in self._lanes if lane.refused]
        return Pending(
            records=sum(run.records for run in runs),
            artefacts=sum(run.artefacts for run in runs),
            error=self._error or (refused[0] if refused else None),
        )

    def flush(self, timeout: float) -> bool:
        """Wait at most `timeout` s for delivery; returns whether everything is delivered."""
        with self._change:
            self._hurry = self._has_news = True
            self._change.notify_all()
            self._change.wait_for(lambda: not any(lane.is_waiting for lane in self._lanes), timeout)
            self._hurry = False
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
            self._change.wait_for(lambda: self._hurry or self._stopped, GATHER_SECONDS)
            self._has_news = False
            return not self._stopped

    def _send_round(self) -> bool:
        """Send everything in the queues; False if a failure ended the round."""
        with self._change:
            lanes = [lane for lane in self._lanes if lane.refused is None]
        # All records first: artefacts are larger, and sending a stored run's records adds some.
        for lane in sorted(lanes, key=lambda lane: lane.has_artefacts):
            if self._stopped or not self._send_lane(lane):
                return False
        if self._error is not None:
            logger.warning("MLflow at %s accepts again what was waiting", self._store)
        self._failures, self._error = 0, None
        self._drop_delivered()
        return True

    def _send_lane(self, lane: _Lane) -> bool:
        try:
            lane.send()
        # The thread must survive every error; what was not sent stays in the queue.
        except Exception as error:
            reason = mlflow_reason(error)
            if is_lasting(error) or isinstance(error, DamagedError):
                lane.refused = reason
                logger.warning("MLflow at %s does not get all of a run: %s", self._store, reason)
                return True
            if self._error is None:
                logger.warning(
                    "MLflow at %s does not accept records, they wait: %s", self._store, reason
                )
            self._failures, self._error = self._failures + 1, reason
            with self._change:
                self._lanes.remove(lane)
                self._lanes.append(lane)
            return False
        return True

    def _drop_delivered(self) -> None:
        # `add` is called after a run's queue has grown: either that is seen here, or `add` runs
        # after this and adds the run again.
        with self._change:
            self._runs = {run for run in self._runs if not run.delivered}
            self._lanes = [lane for lane in self._lanes if lane.run in self._runs]

    def _pause(self) -> None:
        longest = FIRST_PAUSE if self._hurry else LONGEST_PAUSE
        seconds = min(longest, FIRST_PAUSE * 2 ** min(self._failures - 1, 10))
        seconds *= random.uniform(0.5, 1.0)
        with self._change:
            was_hurried = self._hurry
            self._change.wait_for(lambda: self._stopped or self._hurry > was_hurried, seconds)
