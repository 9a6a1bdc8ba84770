"""An MLflow server is killed, fails, or refuses the password while a sweep runs."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import requests

from tests.faults import comparison, sweeps
from tests.faults.sweeps import resume
from tests.integration.conftest import Program
from tests.integration.mlflow_server import USER, MlflowServer, server_script
from tests.integration.tracking.test_refusing_mlflow import TODO, refusing

pytestmark = pytest.mark.thorough

PASSWORD = "planted-mlflow-password"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[MlflowServer]:
    folder = tmp_path / "server"
    folder.mkdir()
    own = MlflowServer(folder)
    own.start()
    own.wait()
    yield own
    own.signal(signal.SIGKILL)


def same(unbroken: Path, program: Program, uri: str) -> None:
    results = program.folder / "results"
    assert comparison.nodes(results) == comparison.nodes(unbroken)
    expected = comparison.logged(f"sqlite:///{unbroken}/mlflow.db")
    assert comparison.logged(uri) == expected


def test_a_server_that_is_away_for_a_minute(
    program: Program, unbroken: Path, server: MlflowServer
) -> None:
    document = sweeps.document(mlflow={"tracking_uri": server.uri})
    program.write(document)
    process = sweeps.start_until(program, "pretrain/seed0: started")
    server.signal(signal.SIGKILL)
    time.sleep(60.0)
    server.start()
    server.wait()
    output = sweeps.ended(process)
    if "did not reach MLflow" in output:  # the sweep ended before the server returned
        resume(program)
    same(unbroken, program, server.uri)


def test_a_server_that_stays_away(program: Program, unbroken: Path, server: MlflowServer) -> None:
    program.write(sweeps.document(mlflow={"tracking_uri": server.uri}))
    process = sweeps.start_until(program, "pretrain/seed0: started")
    server.signal(signal.SIGKILL)
    output = sweeps.ended(process)
    assert f"did not reach MLflow at {server.uri}" in output
    assert "music-rllib resume" in output
    server.start()
    server.wait()
    resume(program)
    resume(program)  # the second call changes nothing
    same(unbroken, program, server.uri)


def test_a_server_that_answers_500(program: Program, unbroken: Path, server: MlflowServer) -> None:
    """The server fails every request from the first run on; `resume` sends everything later."""
    program.write(sweeps.document(mlflow={"tracking_uri": server.uri}))
    process = sweeps.start_until(program, "pretrain/seed0: started")
    server.signal(signal.SIGKILL)
    with refusing(500, server.port):
        output = sweeps.ended(process)
        assert f"did not reach MLflow at {server.uri}" in output
        assert TODO[500] in output
        assert TODO[500] in resume(program, code=2)
    server.start()
    server.wait()
    resume(program)
    same(unbroken, program, server.uri)


@pytest.fixture
def mlflow_server(tmp_path: Path) -> Iterator[str]:
    """`cluster/mlflow-server.sh` on loopback, with sqlite; its URI."""
    with server_script(tmp_path / "server", PASSWORD) as uri:
        yield uri


def test_a_password_that_is_changed(
    program: Program, unbroken: Path, mlflow_server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sweep continues with the old password; a later `resume` uses the new one."""
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", USER)
    program.environment |= {
        "MLFLOW_TRACKING_USERNAME": USER,
        "MLFLOW_TRACKING_PASSWORD": PASSWORD,
    }
    program.write(sweeps.document(mlflow={"tracking_uri": mlflow_server}))
    process = sweeps.start_until(program, "pretrain/seed0: started")
    changed = requests.patch(
        f"{mlflow_server}/api/2.0/mlflow/users/update-password",
        json={"username": USER, "password": PASSWORD[::-1], "current_password": PASSWORD},
        auth=(USER, PASSWORD),
        timeout=60,
    )
    assert changed.ok, changed.text
    output = sweeps.ended(process)
    assert f"did not reach MLflow at {mlflow_server}" in output
    assert TODO[401] in output
    assert TODO[401] in resume(program, code=2)
    program.environment["MLFLOW_TRACKING_PASSWORD"] = PASSWORD[::-1]
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", PASSWORD[::-1])
    resume(program)
    same(unbroken, program, mlflow_server)
    assert PASSWORD not in output
