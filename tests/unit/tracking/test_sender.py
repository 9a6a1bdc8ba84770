"""Failures that a retry may solve, and failures that last."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from mlflow.exceptions import MlflowException
from mlflow.protos import databricks_pb2 as codes

from music_rllib.tracking import sender
from music_rllib.tracking.client import Experiment
from music_rllib.tracking.run_queue import RunQueue
from music_rllib.tracking.sender import Sender
from tests.processes import wait_until


class Failing(RunQueue):
    """A record that MLflow takes after some failures."""

    def __init__(self, code: int, failures: int, key: str = "a", *, is_running: bool = False):
        super().__init__(Experiment.__new__(Experiment), key)
        self.is_running = is_running
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
    monkeypatch.setattr(sender, "LONGEST_UNCLEAR_SECONDS", 1.0)
    monkeypatch.setattr(sender, "UNCLEAR_SECONDS", 0.1)
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
        (codes.BAD_REQUEST, 10**6, False),
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


def test_what_a_server_lacks_does_not_delay_other_runs(started: Sender) -> None:
    run, other = Failing(codes.ENDPOINT_NOT_FOUND, 10**6), Failing(codes.BAD_REQUEST, 0, "b")
    started.add(run)
    wait_until(lambda: run.attempts > 2, 10)
    started.add(other)
    begin = time.monotonic()
    wait_until(lambda: run.refused is not None, 10)
    assert not other.records
    assert time.monotonic() - begin < 0.8, "others succeed, so the failure is not the server's"


def test_a_running_run_that_fails_does_not_delay_finished_ones(started: Sender) -> None:
    """The sweep's own run has artifacts, so it fails as long as they cannot be stored."""
    finished = Failing(codes.BAD_REQUEST, 0, "b")
    started.add(Failing(codes.INTERNAL_ERROR, 10**6, is_running=True))
    started.add(finished)
    wait_until(lambda: not finished.records, 10)
