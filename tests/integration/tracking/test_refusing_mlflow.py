"""An MLflow server that refuses every request: wrong credentials, or an internal error."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from music_rllib.program import main
from tests.integration.conftest import SWEEP
from tests.kept_sweep import kept_sweep

TODO = {
    401: "Set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD in the environment",
    500: "The server's own log says why",
}


@pytest.fixture(params=sorted(TODO))
def status(request: pytest.FixtureRequest) -> int:
    return int(request.param)


def _once_free(port: int, handler: type[BaseHTTPRequestHandler]) -> ThreadingHTTPServer:
    """A server, started as soon as the killed one's workers have released the port."""
    for _ in range(300):
        with contextlib.suppress(OSError):
            return ThreadingHTTPServer(("127.0.0.1", port), handler)
        time.sleep(0.1)
    raise TimeoutError(f"port {port} stays in use")


@contextlib.contextmanager
def refusing(status: int, port: int = 0) -> Iterator[int]:
    """Port of a server that is healthy and refuses every other request."""

    class Refusing(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length") or 0))
            self.send_response(200 if self.path == "/health" else status)
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"no")

        do_POST = do_PATCH = do_GET  # noqa: N815

        def log_message(self, *_: Any) -> None:
            pass

    with _once_free(port, Refusing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


@pytest.fixture
def uri(status: int) -> Iterator[str]:
    with refusing(status) as port:
        yield f"http://user:planted-password@127.0.0.1:{port}"


def check(code: int, message: str, status: int) -> None:
    assert code == 2
    assert message.startswith("error: MLflow at http://127.0.0.1:")
    assert message.count("\n") == 1
    assert TODO[status] in message
    assert "planted" not in message


def test_a_sweep_prints_the_error_and_starts_nothing(
    uri: str,
    status: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    document = {key: value for key, value in SWEEP.items() if key != "environments"}
    document |= {"tasks": ["FetchPush"], "mlflow": {"tracking_uri": uri}}
    Path("sweep.yaml").write_text(yaml.safe_dump(document))
    code = main(["run", "sweep.yaml"])
    check(code, capsys.readouterr().err, status)
    assert not Path("results", "nodes").exists()
    kept = [path for path in Path("results").rglob("*") if path.is_file()]
    assert not any(b"planted" in path.read_bytes() for path in kept)


def test_a_report_that_cannot_be_attached_prints_an_error(
    uri: str, status: int, tmp_path: Path
) -> None:
    from music_rllib.program import app

    folder = kept_sweep(tmp_path, uri)
    done = CliRunner().invoke(app, ["report", str(folder), "--attach", "--no-videos"])
    check(done.exit_code, done.stderr, status)
    assert (folder / "report" / "report.html").is_file()
