"""Accepted tracking URIs, and the messages if a server does not answer."""

from __future__ import annotations

import os
import socket
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, cast

import pytest
from sqlalchemy import create_engine
from sqlalchemy.engine import make_url

from music_rllib.errors import TrackingError
from music_rllib.store.storage import database_url, sqlite_url
from music_rllib.tracking import sender
from music_rllib.tracking import store as store_module
from music_rllib.tracking.store import (
    RECORD,
    SweepRecord,
    check_reachable,
    mlflow_version,
    resolve_store,
)
from tests.ports import free_port


@contextmanager
def server_that_answers(
    status: int, body: bytes, user: tuple[str, str] | None = None
) -> Iterator[str]:
    wanted = f"Basic {b64encode(':'.join(user).encode()).decode()}" if user else None

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            is_known = self.headers.get("Authorization") == wanted
            self.send_response(status if is_known else 401)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_null_is_a_sqlite_file_in_the_storage(tmp_path: Path) -> None:
    store = resolve_store(None, str(tmp_path / "results"))
    assert store.uri == f"sqlite:///{tmp_path}/results/mlflow.db"
    assert store.artifact_root == f"file://{tmp_path}/results/mlartifacts"
    assert "ui --backend-store-uri" in store.ui_command()


def test_a_slurm_task_keeps_no_artifacts_in_the_storage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its database is deleted when it ends."""
    monkeypatch.setenv("MUSIC_RLLIB_STUDIES", str(tmp_path / "scratch"))
    store = resolve_store(f"sqlite:///{tmp_path}/scratch/mlflow.db", str(tmp_path / "results"))
    assert store.artifact_root == f"file://{tmp_path}/scratch/mlartifacts"
    store = resolve_store("http://mlflow:5000", str(tmp_path / "results"))
    assert store.artifact_root is None


def test_a_relative_storage_is_made_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert resolve_store(None, "results").database == tmp_path / "results" / "mlflow.db"
    assert resolve_store("sqlite:///x.db", "results").uri == f"sqlite:///{tmp_path}/x.db"
    assert resolve_store("sqlite:////x.db", "results").uri == "sqlite:////x.db"


@pytest.mark.parametrize("name", ["q?1", "50%", "100%20off", "#1", "u:p@h", "a b", "ü", "$HOME"])
def test_a_database_is_the_file_in_the_storage_with_any_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for store in (resolve_store(None, f"{tmp_path}/{name}"), resolve_store(None, name)):
        assert make_url(store.uri).database == str(store.database)
    assert str(make_url(database_url(sqlite_url(f"/{name}/x.db"))).database) == f"/{name}/x.db"
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / name)
    assert make_url(database_url("sqlite:///x.db")).database == f"{tmp_path}/{name}/x.db"


def test_postgresql_is_reached_by_the_driver_that_is_installed() -> None:
    """SQLAlchemy 2.1 uses psycopg 3 for a URL without a driver."""
    for driver in ("", "+psycopg2"):
        url = make_url(resolve_store(f"postgresql{driver}://me:pw@db:1/x?a=%20b", "results").uri)
        assert url.drivername == "postgresql+psycopg2"
        assert (url.password, url.port, url.query) == ("pw", 1, {"a": " b"})
        create_engine(url).dispose()  # it imports the driver


def test_a_file_uri_is_the_folder_that_it_names() -> None:
    store = resolve_store(None, "file:///data/a%20b")
    assert store.database == Path("/data/a b/mlflow.db")
    assert store.artifact_root == "file:///data/a%20b/mlartifacts"


def test_a_server_keeps_its_artifacts_itself() -> None:
    store = resolve_store("http://u:secret@mlflow:5000", "s3://bucket/sweeps")
    assert store.artifact_root is None
    assert store.ui_command() == "http://mlflow:5000"
    assert store.pages == "http://mlflow:5000"


@pytest.mark.parametrize(
    ("options", "endpoint"),
    [
        ("endpoint_override=minio:9000&scheme=http", "http://minio:9000"),
        ("endpoint_override=http%3A%2F%2Fminio%3A9000", "http://minio:9000"),
        ("endpoint_override=s3.lab", "https://s3.lab"),
        ("region=eu", None),
    ],
)
def test_mlflow_writes_artifacts_to_the_endpoint_of_the_storage(
    options: str, endpoint: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_S3_ENDPOINT_URL", "")  # restored after the test
    monkeypatch.delenv("MLFLOW_S3_ENDPOINT_URL")
    resolve_store("sqlite:////x.db", f"s3://bucket/sweeps?{options}")
    assert os.environ.pop("MLFLOW_S3_ENDPOINT_URL", None) == endpoint


def test_a_database_keeps_artifacts_in_the_storage() -> None:
    store = resolve_store("postgresql+psycopg2://u:p@db/mlflow", "s3://bucket/sweeps/")
    assert store.artifact_root == "s3://bucket/sweeps/mlartifacts"
    assert "u:p" not in store.ui_command()


def test_keys_of_a_bucket_are_used_for_artifacts_and_not_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """MLflow writes the place of artifacts into its database."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "")  # restored after the test
        monkeypatch.delenv(name)
    store = resolve_store("sqlite:////x.db", "s3://AKIA:ab%2Fc@bucket/sweeps?region=eu")
    assert store.artifact_root == "s3://bucket/sweeps/mlartifacts"
    assert os.environ["AWS_ACCESS_KEY_ID"] == "AKIA"
    assert os.environ["AWS_SECRET_ACCESS_KEY"] == "ab/c"


@pytest.mark.parametrize(
    ("uri", "rule"),
    [
        ("ftp://host", "got 'ftp://host'"),
        ("results", "must be null"),
        ("http://", "must name a host"),
        ("http://host:port", "must name a host and a numeric port"),
        ("http://[::1", "must name a host"),
        ("http://user:hunter2@", "got 'http://'"),
        ("", "must be null"),
    ],
)
def test_a_wrong_uri_is_refused_with_its_rule(uri: str, rule: str) -> None:
    with pytest.raises(TrackingError, match=r"mlflow\.tracking_uri") as raised:
        resolve_store(uri, "results")
    assert rule in str(raised.value)


def test_variables_are_named_and_complete_the_settings_that_a_sweep_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "file:///mlruns")
    with pytest.raises(TrackingError, match=r"\(from the environment variable MLFLOW_TRACKING_URI"):
        resolve_store("file:///mlruns", "results")
    for given, kept in (
        ("http://u:hunter2@h:5", "http://h:5"),
        ("postgresql://u:hunter2@h/x", "postgresql+psycopg2://h/x"),
    ):
        monkeypatch.setenv("MLFLOW_TRACKING_URI", given)
        assert "u:hunter2@" in resolve_store(kept, "results").uri
        assert "hunter2" not in resolve_store(f"{kept}1", "results").uri


@pytest.mark.parametrize("record", ["{", "[]", "3", '{"sweep_name": "s"}'])
def test_a_damaged_record_is_named(tmp_path: Path, record: str) -> None:
    assert SweepRecord.read(str(tmp_path), "s") is None
    (tmp_path / "s" / RECORD).parent.mkdir(parents=True)
    (tmp_path / "s" / RECORD).write_text(record)
    with pytest.raises(TrackingError, match=r"sweep\.json must hold a sweep's record"):
        SweepRecord.read(str(tmp_path), "s")


def test_a_bucket_needs_a_server() -> None:
    with pytest.raises(TrackingError, match="must be set if storage is not a local folder"):
        resolve_store(None, "s3://bucket/sweeps")


def test_an_unreachable_server_is_named_without_its_password() -> None:
    port = free_port()
    store = resolve_store(f"http://user:hunter2@127.0.0.1:{port}", "results")
    with pytest.raises(TrackingError, match="Connection refused") as raised:
        check_reachable(store)
    message = str(raised.value)
    assert f"http://127.0.0.1:{port}" in message
    assert "set it to null" in message
    assert "hunter2" not in message


def test_a_server_that_hangs_is_given_up_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "ANSWER_SECONDS", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(TrackingError, match="no answer within"):
            check_reachable(resolve_store(uri, "results"))


def test_an_unknown_host_is_called_unknown() -> None:
    with pytest.raises(TrackingError, match="Name or service not known"):
        check_reachable(resolve_store("http://no-such-host.invalid:5000", "results"))


@pytest.mark.parametrize(
    ("status", "body", "reason"),
    [
        (503, b"starting", "status 503"),
        (403, b"Invalid Host header - possible DNS rebinding attack detected", "--allowed-hosts"),
    ],
)
def test_the_message_of_a_refusing_server_is_shown(status: int, body: bytes, reason: str) -> None:
    with server_that_answers(status, body) as uri, pytest.raises(TrackingError, match=reason):
        check_reachable(resolve_store(uri, "results"))


def test_a_healthy_server_passes() -> None:
    with server_that_answers(200, b"OK") as uri:
        check_reachable(resolve_store(uri, "results"))


class SlowRun:
    """A run whose records take at least 0.6 s altogether."""

    node_key, source, refused, is_running = "a", None, None, False
    records = 30

    def send(self, *, policy: bool) -> None:
        while self.records:
            time.sleep(0.02)
            self.records -= 1


def test_the_end_waits_for_mlflow_while_there_is_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "SAY_SECONDS", 0.05)
    thread, run, said = sender.Sender("the store"), cast("Any", SlowRun()), list[int]()
    thread.add(run)
    thread.start()
    assert not thread.flush(0.1), "without anybody to tell, this is the whole time"
    assert thread.flush(0.5, said.append)
    assert said == sorted(said, reverse=True)
    assert len(said) > 1
    thread.stop()


class DeliveredRun:
    """A run that waits until its policy is sent, while `news` arrives after everything was sent."""

    refused, source, is_running = None, None, False

    def __init__(self, name: str, news: Callable[[], None]) -> None:
        self.node_key, self.records, self._news = name, 1, news

    def send(self, *, policy: bool) -> None:
        self._news()
        self.records -= policy


def test_policies_are_sent_although_metrics_never_pause() -> None:
    """Otherwise a sweep of many short runs would keep all their queues until its end."""
    thread = sender.Sender("the store")

    def news() -> None:
        thread._has_news = True

    training = DeliveredRun("training", news)
    training.is_running = True
    for run in (training, *(DeliveredRun(str(i), news) for i in range(5))):
        thread.add(cast("Any", run))
    for left in (5, 4, 3, 2, 1):
        assert thread._send_round()
        assert thread.pending().records == left
    assert [run.node_key for run in thread._runs] == ["training"]


def test_the_version_is_asked_for_with_mlflows_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server with basic authentication answers /health without them, but not /version."""
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "me")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "a-word")
    with server_that_answers(200, b"3.17.2", ("me", "a-word")) as address:
        assert mlflow_version(resolve_store(address, "results")) == "3.17.2"
