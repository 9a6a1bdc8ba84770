"""An MLflow server that is killed while a sweep goes on: for a minute, and for good."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults import comparison, sweeps
from tests.faults.test_full_disks import deliver
from tests.integration.conftest import Program
from tests.integration.test_mlflow_tracking import Server

pytestmark = pytest.mark.thorough


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    folder = tmp_path / "server"
    folder.mkdir()
    own = Server(folder)
    own.start()
    own.wait()
    yield own
    own.signal(signal.SIGKILL)


def same(unbroken: Path, program: Program, server: Server) -> None:
    results = program.folder / "results"
    assert comparison.nodes(results) == comparison.nodes(unbroken)
    expected = comparison.logged(f"sqlite:///{unbroken}/mlflow.db")
    assert comparison.logged(server.uri) == expected


def test_a_server_that_is_away_for_a_minute(
    program: Program, unbroken: Path, server: Server
) -> None:
    document = sweeps.document(mlflow={"tracking_uri": server.uri})
    program.write(document)
    process = sweeps.start_until(program, "pretrain/Point/seed0: started")
    server.signal(signal.SIGKILL)
    time.sleep(60.0)
    server.start()
    server.wait()
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    if "did not reach MLflow" in output:  # the sweep was over before the server was back
        deliver(program)
    same(unbroken, program, server)


def test_a_server_that_stays_away(program: Program, unbroken: Path, server: Server) -> None:
    program.write(sweeps.document(mlflow={"tracking_uri": server.uri}))
    process = sweeps.start_until(program, "pretrain/Point/seed0: started")
    server.signal(signal.SIGKILL)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert f"did not reach MLflow at {server.uri}" in output
    assert "python -m music_rllib.tracking deliver" in output
    server.start()
    server.wait()
    deliver(program)
    deliver(program)  # twice changes nothing
    same(unbroken, program, server)
