"""The live page: who can read it, and the progress that it shows."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from music_rllib.errors import TrackingError
from music_rllib.experiment import sweep_files
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.report import live
from music_rllib.report.live import Progress
from music_rllib.store.lease import this_machine

RUNNING = {"run": "train/A/seed0", "env_steps": 40, "budget": 100, "metric": "m", "value": None}
CONFIG = {"tasks": ["A"], "stages": [{"name": "train", "tasks": None}]}


def write_state(folder: Path, done: int, heartbeat: float, to_come: int = 0, **driver: Any) -> None:
    state = {
        "sweep": "tiny",
        "driver": {
            "pid": 1,
            "host": "elsewhere",
            "machine": f"not {this_machine()}",
            "process_started": 0.0,
            "started": heartbeat - 100,
            "heartbeat": heartbeat,
            "ended": None,
            "outcome": "running",
            **driver,
        },
        "stages": [
            {"name": "train", "variant": "tac", "trials": 3, "runs": {"started": 1, "waiting": 2}}
        ],
        "env_steps": {"done": done, "left": 300 - done, "to_come": to_come},
        "running": [RUNNING],
        "best": None,
        "searches": [],
        "failures": [{"run": "train/B", "cause": "<b>no</b>", "log": "x"}],
    }
    (folder / "tiny").mkdir(exist_ok=True)
    (folder / "tiny" / sweep_files.CONFIG).write_text(json.dumps(CONFIG))
    (folder / "tiny" / sweep_files.STATE).write_text(json.dumps(state))


@pytest.fixture
def found(tmp_path: Path) -> SweepLocation:
    return SweepLocation(storage=str(tmp_path), name="tiny")


def test_speed_and_time_left_are_measured_over_the_last_minutes(
    found: SweepLocation, tmp_path: Path
) -> None:
    progress, now = Progress(found), time.time()
    assert progress.read() == {"sweep": "tiny", "state": "not started"}
    write_state(tmp_path, 100, now - 20)
    assert progress.read()["speed"] is None
    write_state(tmp_path, 200, now - 10)
    seen = progress.read()
    assert (seen["state"], seen["done"], seen["left"]) == ("running", 200, 100)
    assert (seen["speed"], seen["seconds_left"]) == pytest.approx((10.0, 10.0))
    assert [run["run"] for run in seen["running"]] == ["seed0"], "the label is short"
    write_state(tmp_path, 200, now - 10, to_come=500)
    seen = progress.read()
    assert (seen["left"], seen["at_most"], seen["seconds_left"]) == (600, True, pytest.approx(60.0))
    # Another driver, which counts other steps, writes the file in turn.
    write_state(tmp_path, 150, now - 9, pid=2)
    assert progress.read()["speed"] is None
    write_state(tmp_path, 220, now - 8)
    assert progress.read()["speed"] == pytest.approx(10.0)
    # A driver without a recent heartbeat is not running.
    write_state(tmp_path, 200, now - 1000)
    seen = progress.read()
    assert (seen["state"], seen["speed"], seen["running"]) == ("interrupted", None, [])
    write_state(tmp_path, 300, now, ended=now, outcome="finished")
    assert progress.read()["state"] == "finished"


@pytest.fixture
def served(found: SweepLocation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of the page."""
    monkeypatch.setattr(live, "LEAST_PAUSE", 0.05)
    monkeypatch.setattr(live, "READ_SECONDS", 0.2)
    write_state(tmp_path, 100, time.time())
    made = iter(range(1000))
    page = live.LivePage(lambda: f"<p>page {next(made)}", Progress(found))
    http = live.make_server(page, 0)
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{http.server_port}"
    http.shutdown()
    http.server_close()
    page.close()


def ask(url: str, method: str = "GET", **headers: str) -> tuple[int, str]:
    request = Request(
        url, method=method, headers={k.replace("_", "-"): v for k, v in headers.items()}
    )
    try:
        with urlopen(request, timeout=30) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def test_only_requests_to_this_machine_are_answered(served: str, tmp_path: Path) -> None:
    for host in ("127.0.0.1", "localhost", "localhost:80"):  # browsers omit port 80
        assert ask(f"{served}/", Host=host)[0] == 200
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example"):
        assert ask(f"{served}/", Host=host)[0] == 403
    assert ask(f"{served}/stop", "POST")[0] == 501
    assert not (tmp_path / "tiny" / sweep_files.STOP).exists()


def test_an_incomplete_request_is_closed(served: str) -> None:
    port = int(served.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: local")
        assert client.recv(1) == b"", "the connection is closed"


def test_many_incomplete_requests_neither_hold_threads_nor_keep_others_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "CONNECTIONS", 8)
    page: Any = SimpleNamespace(html="<p>page")
    http = live.make_server(page, 0)
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    threads, half = threading.active_count(), []
    for _ in range(80):
        half.append(socket.create_connection(("127.0.0.1", http.server_port), timeout=30))
        half[-1].sendall(b"GET / HTTP/1.1\r\nHost: local")
    assert ask(f"http://127.0.0.1:{http.server_port}/") == (200, "<p>page")
    deadline = time.monotonic() + 5
    while threading.active_count() > threads + live.CONNECTIONS:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    for client in half:
        client.close()
    http.shutdown()
    http.server_close()


def test_the_command_to_stop_or_resume_has_no_keys(tmp_path: Path) -> None:
    class Bucket(SweepLocation):
        def read(self, name: str) -> Any:
            return json.loads((tmp_path / "tiny" / name).read_text())

    progress = Progress(Bucket(storage="s3://KEY:SECRET@bucket/sweeps", name="tiny"))
    write_state(tmp_path, 100, time.time())
    command = progress.read()["command"]
    assert command == "music-rllib stop tiny --storage s3://bucket/sweeps"
    write_state(tmp_path, 100, time.time(), ended=time.time(), outcome="stopped")
    assert progress.read()["command"].startswith("music-rllib resume ")
    write_state(tmp_path, 300, time.time(), ended=time.time(), outcome="finished")
    assert progress.read()["command"] is None


def test_the_page_is_updated_while_the_sweep_runs(served: str) -> None:
    assert ask(f"{served}/")[1].startswith("<p>page ")
    before = json.loads(ask(f"{served}/state")[1])
    assert before["state"] == "running"
    deadline = time.monotonic() + 60
    while json.loads(ask(f"{served}/state")[1])["version"] == before["version"]:
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("outcome", ["running", "finished"])
def test_a_page_that_fails_is_reported_and_made_later(
    found: SweepLocation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: str
) -> None:
    """The thread that makes pages survives an error."""
    monkeypatch.setattr(live, "LEAST_PAUSE", 0.05)
    write_state(tmp_path, 100, time.time())
    answers: Iterator[Any] = chain(["one"], repeat(TrackingError("no answer"), 3), repeat("two"))

    def make() -> str:
        answer = next(answers)
        # The sweep ends while the first page is made.
        write_state(tmp_path, 100, time.time(), outcome=outcome, ended=time.time())
        if isinstance(answer, Exception):
            raise answer
        return str(answer)

    page = live.LivePage(make, Progress(found))
    errors = set()
    deadline = time.monotonic() + 60
    while page.html != "two":
        errors.add(page.state().get("error"))
        assert time.monotonic() < deadline
        time.sleep(0.01)
    page.close()
    assert "The page is out of date: no answer" in errors
    assert "error" not in page.state()
