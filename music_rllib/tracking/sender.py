"""The thread that brings runs to MLflow while the sweep goes on."""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable
from dataclasses import dataclass

from music_rllib.store.object_folder import DamagedError
from music_rllib.tracking.mlflow_client import first_line, is_lasting
from music_rllib.tracking.projection import RunProjection

logger = logging.getLogger(__name__)

GATHER_SECONDS = 0.2
"""How long a round waits for more records, so that several go with one request."""
FIRST_PAUSE = 0.5
LONGEST_PAUSE = 30.0


@dataclass(frozen=True, kw_only=True)
class Pending:
    """What MLflow does not have yet."""

    records: int
    artefacts: int
    error: str | None
    """Why the last attempt failed; None while all is well."""

    def __bool__(self) -> bool:
        return self.records > 0 or self.artefacts > 0


@dataclass(eq=False)
class _Lane:
    """A run's records, or its artefacts: one must not keep the other waiting."""

    run: RunProjection
    send: Callable[[], None]
    refused: str | None = None


class Sender(threading.Thread):
    """Sends every run's records in order; after a failure it pauses, longer each time, and repeats.

    A failure that can pass (server down, busy, disk full) ends the round, and the lane that met
    it goes to the back, so that one bad run cannot keep the others waiting. After a lasting one
    (a refused value, a deleted run, a damaged node) the lane rests until the sweep is started
    again. A run that ended and is delivered is forgotten, so that a round costs what is under way.
    """

    def __init__(self, store: str) -> None:
        """``store`` is its public name, for messages."""
        super().__init__(name="mlflow-sender", daemon=True)
        self._store = store
        self._runs: set[RunProjection] = set()
        self._records: list[_Lane] = []
        self._artefacts: list[_Lane] = []
        self._change = threading.Condition()
        self._news = self._hurry = self._stopped = False
        self._failures = 0
        self._error: str | None = None

    def add(self, run: RunProjection) -> None:
        """Say that a run has something new to send."""
        with self._change:
            if run not in self._runs:
                self._runs.add(run)
                self._records.append(_Lane(run, run.send_records))
                self._artefacts.append(_Lane(run, run.send_artefacts))
            self._wake()

    def _wake(self) -> None:
        self._news = True
        self._change.notify_all()

    def pending(self) -> Pending:
        """What is still to be sent, and why it has not been."""
        with self._change:
            runs = list(self._runs)
            refused = [lane.refused for lane in self._lanes() if lane.refused]
        return Pending(
            records=sum(run.records for run in runs),
            artefacts=sum(run.artefacts for run in runs),
            error=self._error or (refused[0] if refused else None),
        )

    def flush(self, timeout: float) -> bool:
        """Wait until all is delivered; False where it is not after ``timeout`` s or is refused."""
        with self._change:
            self._hurry = True
            self._wake()
            self._change.wait_for(lambda: not self._has_work(), timeout)
            self._hurry = False
        return not self.pending()

    def stop(self) -> None:
        """End after the request that is under way."""
        with self._change:
            self._stopped = True
            for run in self._runs:
                run.cancel()
            self._change.notify_all()

    def run(self) -> None:
        """Send in rounds until stopped."""
        while self._wait_for_news():
            done = self._round()
            with self._change:
                self._news = self._news or not done
                self._change.notify_all()
            if not done:
                self._pause()

    def _wait_for_news(self) -> bool:
        with self._change:
            self._change.wait_for(lambda: self._news or self._stopped)
            self._change.wait_for(lambda: self._hurry or self._stopped, GATHER_SECONDS)
            self._news = False
            return not self._stopped

    def _round(self) -> bool:
        """Send what there is; False where a failure ended the round."""
        for lanes in (self._records, self._artefacts):
            with self._change:
                waiting = [lane for lane in lanes if lane.refused is None]
            for lane in waiting:
                if self._stopped or not self._attempt(lane, lanes):
                    return False
        if self._error is not None:
            logger.warning("MLflow at %s accepts again what was waiting", self._store)
        self._failures, self._error = 0, None
        self._forget_ended()
        return True

    def _forget_ended(self) -> None:
        # Whoever tells a run something calls `add` after it: either it is seen here, or `add`
        # comes after this.
        with self._change:
            self._runs = {run for run in self._runs if not run.delivered}
            self._records = [lane for lane in self._records if lane.run in self._runs]
            self._artefacts = [lane for lane in self._artefacts if lane.run in self._runs]

    def _lanes(self) -> list[_Lane]:
        return [*self._records, *self._artefacts]

    def _attempt(self, lane: _Lane, lanes: list[_Lane]) -> bool:
        try:
            lane.send()
        # Whatever goes wrong here, the thread must live: what was not sent waits.
        except Exception as error:
            reason = first_line(error)
            if is_lasting(error) or isinstance(error, DamagedError):
                lane.refused = reason
                logger.warning("MLflow at %s does not get all of a run: %s", self._store, reason)
                return True
            if self._error is None:
                logger.warning(
                    "MLflow at %s does not accept records, they wait: %s",
                    self._store,
                    reason,
                )
            self._failures, self._error = self._failures + 1, reason
            with self._change:
                lanes.remove(lane)
                lanes.append(lane)
            return False
        return True

    def _pause(self) -> None:
        longest = FIRST_PAUSE if self._hurry else LONGEST_PAUSE
        seconds = min(longest, FIRST_PAUSE * 2 ** min(self._failures - 1, 10))
        seconds *= random.uniform(0.5, 1.0)
        with self._change:
            was_hurried = self._hurry
            self._change.wait_for(lambda: self._stopped or self._hurry > was_hurried, seconds)

    def _has_work(self) -> bool:
        """Whether something waits that was not refused. Called with the lock held."""
        return any(lane.refused is None and lane.run.records for lane in self._records) or any(
            lane.refused is None and lane.run.artefacts for lane in self._artefacts
        )
