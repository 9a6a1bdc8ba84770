"""Where runs are logged: the tracking URI, checked, and its artefacts. Loads no MLflow."""

from __future__ import annotations

import shlex
import shutil
import socket
import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

from music_rllib.errors import TrackingError
from music_rllib.experiment import sweep_files
from music_rllib.redaction import redact
from music_rllib.store.object_folder import StorageError

CONNECT_SECONDS = 3.0
ANSWER_SECONDS = 5.0
_DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
_SERVERS = ("http", "https")
_LOW_MEMORY = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"
"""Without it, a server of MLflow 3 starts job consumers of 2.5 GB, which tracking never uses."""


@dataclass(frozen=True, kw_only=True)
class TrackingStore:
    """A tracking URI and where an experiment's artefacts go."""

    uri: str
    """For MLflow itself; may hold a password. Show :attr:`public_uri` instead."""
    artefact_root: str | None
    """URI below which artefacts are kept; None where the server decides."""
    database: Path | None = None
    """The embedded sqlite file, where there is one."""

    @property
    def public_uri(self) -> str:
        """The URI without user and password."""
        return redact(self.uri)

    @property
    def is_server(self) -> bool:
        """Whether an MLflow server stands between us and the database."""
        return self.uri.startswith(("http://", "https://"))

    def ui_command(self) -> str:
        """What opens MLflow's pages: a command, or the address of the server."""
        if self.is_server:
            return self.public_uri
        arguments = [_mlflow_program(), "ui", "--backend-store-uri", self.public_uri]
        return f"{_LOW_MEMORY} {shlex.join(arguments)}"

    @property
    def pages(self) -> str:
        """The address of MLflow's pages: the server's, or that of what `ui_command` starts."""
        return self.public_uri.rstrip("/") if self.is_server else "http://127.0.0.1:5000"


RECORD = "tracking/sweep.json"
"""Of a sweep, in its folder."""


@dataclass(frozen=True, kw_only=True)
class SweepRecord:
    """What a later driver must know to go on with this sweep's runs in MLflow."""

    sweep_name: str
    sweep_id: str
    tracking_uri: str | None
    """Without a password; None for the sqlite file in the storage."""

    @classmethod
    def read(cls, storage: str, sweep_name: str) -> Self | None:
        """The record of the sweep in the folder `sweep_name` of a storage; None where none is.

        Raises:
            TrackingError: where there is one that cannot be read.
        """
        place = f"{sweep_name}/{RECORD}"
        try:
            found = sweep_files.read(storage, place)
            if found is None:
                return None
            return cls(**{field.name: found[field.name] for field in fields(cls)})
        except (StorageError, TypeError, KeyError) as error:
            raise TrackingError(
                f"{redact(storage)}/{place} must hold a sweep's record, got: {error}"
            ) from error

    def write(self, storage: str) -> None:
        """Keep the record with the sweep: in a bucket too, where a driver elsewhere goes on.

        Raises:
            TrackingError: the storage cannot be written.
        """
        try:
            text = sweep_files.as_json(asdict(self))
            sweep_files.write(storage, f"{self.sweep_name}/{RECORD}", text)
        except StorageError as error:
            raise TrackingError(str(error)) from error


def resolve_store(tracking_uri: str | None, storage: str) -> TrackingStore:
    """The store that ``mlflow.tracking_uri`` means.

    Args:
        tracking_uri: a server (``http(s)://``), a database (``sqlite:///FILE``,
            ``postgresql://...``), or None for a sqlite file in ``storage`` with the artefacts
            in a folder beside it.
        storage: the sweep's storage: a folder or a bucket URI.

    Raises:
        TrackingError: where the URI is none of these, or is None with a bucket.
    """
    folder = local_folder(storage)
    if tracking_uri is None:
        if folder is None:
            raise TrackingError(
                "mlflow.tracking_uri must be set where storage is not a local folder, "
                f"got storage {redact(storage)}: a sqlite file cannot live in a bucket. "
                "Name an MLflow server there."
            )
        return _embedded(folder)
    scheme = _scheme(tracking_uri)
    if scheme in _SERVERS:
        return TrackingStore(uri=tracking_uri, artefact_root=None)
    root = f"{storage.rstrip('/')}/mlartifacts" if folder is None else _artefacts_in(folder)
    return TrackingStore(uri=tracking_uri, artefact_root=root)


def local_folder(storage: str) -> Path | None:
    """``storage`` as an absolute path; None where it is a bucket."""
    if storage.startswith("file://"):
        return Path(urlsplit(storage).path)
    if "://" in storage:
        return None
    return Path(storage).expanduser().absolute()


def check_reachable(store: TrackingStore) -> None:
    """Ask a server for its health; nothing to ask of a database file.

    Raises:
        TrackingError: where no MLflow server answers within ``CONNECT_SECONDS`` and
            ``ANSWER_SECONDS``.
    """
    if not store.is_server:
        return
    import requests

    try:
        answer = requests.get(
            f"{store.uri.rstrip('/')}/health", timeout=(CONNECT_SECONDS, ANSWER_SECONDS)
        )
    except requests.RequestException as error:
        raise _unreachable(store, _reason(store, error)) from error
    if answer.status_code == 403 and "host" in answer.text.lower():
        raise _unreachable(
            store, "it refuses this host name; start it with --allowed-hosts naming it"
        )
    if answer.status_code >= 500:
        raise _unreachable(store, f"it answered with status {answer.status_code}")


def version(store: TrackingStore) -> str | None:
    """The MLflow whose pages show the store; None where a server doesn't say."""
    import mlflow
    import requests

    if not store.is_server:
        return mlflow.__version__
    try:
        answer = requests.get(
            f"{store.uri.rstrip('/')}/version", timeout=(CONNECT_SECONDS, ANSWER_SECONDS)
        )
        return answer.text.strip() if answer.ok else None
    except requests.RequestException:
        return None


def _embedded(folder: Path) -> TrackingStore:
    database = folder / "mlflow.db"
    return TrackingStore(
        uri=f"sqlite:///{database}", artefact_root=_artefacts_in(folder), database=database
    )


def _artefacts_in(folder: Path) -> str:
    return (folder / "mlartifacts").as_uri()


def _scheme(uri: str) -> str:
    scheme = uri.partition("://")[0].partition("+")[0] if "://" in uri else ""
    if scheme not in (*_SERVERS, *_DATABASES):
        raise TrackingError(
            "mlflow.tracking_uri must be null (a sqlite file in the storage folder), "
            f"http(s)://HOST:PORT or a database URI ({', '.join(_DATABASES)}), got {redact(uri)!r}"
        )
    if scheme in _SERVERS and not _names_a_host(uri):
        raise TrackingError(
            f"mlflow.tracking_uri must name a host and a numeric port, got {redact(uri)!r}"
        )
    return scheme


def _names_a_host(uri: str) -> bool:
    try:
        parts = urlsplit(uri)
        return bool(parts.hostname) and parts.port != 0
    except ValueError:
        return False


def _unreachable(store: TrackingStore, reason: str) -> TrackingError:
    return TrackingError(
        f"mlflow.tracking_uri must name an MLflow server that answers, got {store.public_uri}: "
        f"{reason}. Start that server, correct the URI, or leave it null for a local sqlite file."
    )


def _reason(store: TrackingStore, error: Exception) -> str:
    import requests

    host = urlsplit(store.uri).hostname or ""
    if isinstance(error, requests.exceptions.SSLError):
        return f"its certificate was not accepted ({redact(str(error))})"
    if isinstance(error, requests.Timeout):
        return f"no answer within {CONNECT_SECONDS + ANSWER_SECONDS:.0f} s"
    try:
        socket.getaddrinfo(host, None)
    except OSError:
        return f"the host name {host!r} is not known here"
    if "refused" in str(error):
        return "the connection was refused"
    return f"no connection ({redact(str(error))})"


def _mlflow_program() -> str:
    """The ``mlflow`` of this Python, by its plain name where that is the one on the PATH."""
    own = Path(sys.executable).with_name("mlflow")
    found = shutil.which("mlflow")
    return str(own) if own.exists() and (found is None or Path(found) != own) else "mlflow"
