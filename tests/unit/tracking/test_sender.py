"""Failures that a retry may solve, and failures that last."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from mlflow.exceptions import MlflowException
from mlflow.protos import databricks_pb2 as codes

from music_rllib.tracking import sender
from music_rllib.tracking.client import Experiment
from music_rllib.tracking.run_queue import RunQueue
from music_rllib.tracking.sender import Sender


class Failing(RunQueue):
    """A record that MLflow takes after some failures."""

    def __init__(self, code: int, failures: int) -> None:
        super().__init__(Experiment.__new__(Experiment), "a")
        self.code, self.failures, self.attempts = code, failures, 0
        self._info = type("Info", (), {"source_node": None})()
        self._records.append(lambda: None)

    def send(self, *, policy: bool = True) -> None:
        self.attempts += 1
        if self.attempts <= self.failures:
            raise MlflowException("no", error_code=self.code)
        self.drop()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[Sender]:
    monkeypatch.setattr(sender, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(sender, "GATHER_SECONDS", 0.001)
    thread = Sender("http://mlflow")
    thread.start()
    yield thread
    thread.stop()
    thread.join(5.0)


@pytest.mark.parametrize(
    ("code", "failures", "arrives"),
    [
        (codes.ENDPOINT_NOT_FOUND, 5, True),  # of a proxy whose server starts again
        (codes.BAD_REQUEST, 5, True),  # of a database that has failed over
        (codes.BAD_REQUEST, 100, False),
        (codes.INTERNAL_ERROR, 50, True),
        (codes.INVALID_PARAMETER_VALUE, 1, False),
    ],
)
def test_a_failure_that_may_pass_loses_nothing(
    started: Sender, code: int, failures: int, arrives: bool
) -> None:
    run = Failing(code, failures)
    started.add(run)
    assert started.flush(10.0) == arrives
    assert bool(run.refused) != arrives
    assert run.attempts <= failures + 1
