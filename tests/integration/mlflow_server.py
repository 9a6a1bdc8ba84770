"""An MLflow server that can be killed and restarted."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote
from urllib.request import urlopen

import pytest
import requests

from tests.ports import free_port

PATIENCE = 180.0
SCRIPT = Path(__file__).parents[2] / "cluster" / "mlflow-server.sh"
USER = "music"
"""First user of `server_script`."""


@contextlib.contextmanager
def server_script(folder: Path, password: str, *databases: str) -> Iterator[str]:
    """`cluster/mlflow-server.sh` on loopback, with databases of runs and of users; its URI."""
    port = free_port()
    folder.mkdir()
    runs, users = databases or (f"sqlite:///{folder}/runs.db", f"sqlite:///{folder}/users.db")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "TMPDIR": str(folder),
        "MLFLOW_BACKEND_STORE_URI": runs,
        "MLFLOW_AUTH_DATABASE_URI": users,
        "MLFLOW_ADMIN_USERNAME": USER,
        "MLFLOW_ADMIN_PASSWORD": password,
        "MLFLOW_FLASK_SERVER_SECRET_KEY": "planted-flask-key",
        "MLFLOW_ARTIFACTS": str(folder / "artefacts"),
        "MLFLOW_PORT": str(port),
        "MLFLOW_WORKERS": "1",
    }
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            ["sh", SCRIPT],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        uri = f"http://127.0.0.1:{port}"
        _wait_for(uri, process, folder / "log")
        yield uri
    finally:
        process.terminate()
        try:
            process.wait(timeout=60)
        finally:
            # Processes that survived a kill; the process group belongs to this server.
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert not list(folder.rglob("basic_auth.ini")), "the server must delete its password's file"


def _wait_for(uri: str, process: subprocess.Popen[Any], log: Path) -> None:
    for _ in range(600):
        assert process.poll() is None, log.read_text()
        try:
            if requests.get(f"{uri}/health", timeout=5).ok:
                return
        except requests.ConnectionError:
            time.sleep(0.2)
    pytest.fail(log.read_text())


class MlflowServer:
    """``mlflow server`` on `mlflow.db` in a folder, on its own port."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        self.wait()
        return self

    def __exit__(self, *_: object) -> None:
        self.signal(signal.SIGKILL)

    def start(self) -> None:
        command = [sys.executable, "-m", "mlflow", "server", "--workers", "1"]
        command += ["--host", "127.0.0.1", "--port", str(self.port)]
        command += ["--backend-store-uri", f"sqlite:///{self.folder}/mlflow.db"]
        command += ["--artifacts-destination", str(self.folder / "artefacts")]
        with (self.folder / "server.log").open("ab") as log:
            self._process = subprocess.Popen(
                command,
                env={**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the process group of the server and its worker."""
        if self._process is None:
            return
        os.killpg(self._process.pid, number)
        if number == signal.SIGKILL:
            self._process.wait()
            self._process = None

    def wait(self) -> None:
        """Wait until it answers."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            assert self._process is not None
            if self._process.poll() is not None:
                break
            try:
                urlopen(f"{self.uri}/health", timeout=2).close()
            except OSError:
                time.sleep(0.1)
            else:
                return
        pytest.fail("the server did not start: " + (self.folder / "server.log").read_text())


def comparing(server: str, experiment: str, runs: list[str]) -> str:
    """URL of MLflow's comparison of selected runs."""
    chosen, experiments = (quote(json.dumps(ids)) for ids in (runs, [str(experiment)]))
    return f"{server}/#/compare-runs?runs={chosen}&experiments={experiments}"
