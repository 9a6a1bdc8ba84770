"""The store of a sweep in MLflow: tracking URI, place of artifacts, and the sweep's record.

Loading this module does not load MLflow.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import sqlite3
import sys
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Self
from urllib.parse import parse_qsl, unquote, urlsplit

from music_rllib.errors import TrackingError
from music_rllib.experiment.sweep_files import SweepLocation, as_json
from music_rllib.names import VARIABLE_STUDIES
from music_rllib.redaction import redact
from music_rllib.store.storage import (
    StorageError,
    database_url,
    is_remote,
    sqlite_url,
    sweep_folder,
)

if TYPE_CHECKING:
    import requests


CONNECT_SECONDS = 3.0
ANSWER_SECONDS = 5.0
_DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
_SERVERS = ("http", "https")
SETTING, VARIABLE = "mlflow.tracking_uri", "MLFLOW_TRACKING_URI"
"""The setting of a sweep, and MLflow's own variable, which is used if the setting is absent."""
_LOW_MEMORY = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"
"""Keeps a server of MLflow 3 from starting job consumers (2.5 GB), which tracking never uses."""
_PLACES = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
)
"""Tables and columns of MLflow's database with the URIs of artifacts."""
_OTHER_PLACES = (
    "SELECT 1 FROM experiments WHERE artifact_location LIKE ?1 "
    "AND substr(artifact_location, 1, length(?2)) != ?2"
)
_LOCK_SECONDS = 60
RECORD = "tracking/sweep.json"
"""File of a `SweepRecord` in the sweep's folder."""


@dataclass(frozen=True, kw_only=True)
class TrackingStore:
    """A tracking URI, and the place of artifacts."""

    uri: str
    """URI for MLflow; may hold a password, so messages show `public_uri`."""
    artifact_root: str | None
    """URI of the folder for artifacts; None if the server decides."""
    database: Path | None = None
    """The SQLite file in the storage; None for other stores."""

    @property
    def public_uri(self) -> str:
        return redact(self.uri)

    @property
    def is_server(self) -> bool:
        return self.uri.startswith(("http://", "https://"))

    def ui_command(self) -> str:
        """The command that serves MLflow's pages, or the address of the server."""
        if self.is_server:
            return self.public_uri
        # The plain name, unless another `mlflow` is first on the PATH.
        program, found = Path(sys.executable).with_name("mlflow"), shutil.which("mlflow")
        is_plain = not program.exists() or str(program) == found
        command = "mlflow" if is_plain else str(program)
        arguments = [command, "ui", "--backend-store-uri", self.public_uri]
        return f"{_LOW_MEMORY} {shlex.join(arguments)}"

    @property
    def pages(self) -> str:
        """The address of MLflow's pages, on the server or once `ui_command` runs."""
        return self.public_uri.rstrip("/") if self.is_server else "http://127.0.0.1:5000"


@dataclass(frozen=True, kw_only=True)
class SweepRecord:
    """The ids of a sweep in MLflow, by which a later driver continues its runs."""

    sweep_name: str
    sweep_id: str
    tracking_uri: str | None
    """URI without its password; None for the SQLite file in the storage."""
    experiment_id: str = ""
    run_id: str = ""
    """Id of the parent run of the current plan; empty until it is known."""

    @classmethod
    def read(cls, storage: str, sweep_name: str) -> Self | None:
        """The record of a sweep in a storage; None if there is none.

        Raises:
            TrackingError: The record cannot be read.
        """
        location = SweepLocation(storage=storage, name=sweep_name)
        try:
            record = location.read(RECORD)
            if record is None:
                return None
            return cls(**{key: record[key] for key in cls.__dataclass_fields__ if key in record})
        except (StorageError, TypeError, KeyError) as error:
            raise TrackingError(
                f"{location.place}/{RECORD} must hold a sweep's record, got: {error}"
            ) from error

    def write(self, storage: str) -> None:
        """Write the record to the storage, so that drivers on other machines find it.

        Raises:
            TrackingError: The storage cannot be written.
        """
        try:
            location = SweepLocation(storage=storage, name=self.sweep_name)
            location.write(RECORD, as_json(asdict(self)))
        except StorageError as error:
            raise TrackingError(str(error)) from error


def resolve_store(tracking_uri: str | None, storage: str) -> TrackingStore:
    """The store that `mlflow.tracking_uri` names.

    Args:
        tracking_uri: A server (`http(s)://`), a database (`sqlite:///FILE`, `postgresql://...`),
            or None for an SQLite file in `storage`.
        storage: The sweep's storage, a folder or a bucket URI. Artifacts are stored there, unless a
            server stores them.

    Raises:
        TrackingError: The URI is none of these, or is None although `storage` is a bucket.
    """
    remote = is_remote(storage)
    folder = None if remote else sweep_folder(storage, "").expanduser().absolute()
    if folder is None:
        artifacts = f"{redact(storage).partition('?')[0].rstrip('/')}/mlartifacts"
    else:
        artifacts = (folder / "mlartifacts").as_uri()
    if tracking_uri and (own := os.environ.get(VARIABLE_STUDIES)) and own in tracking_uri:
        artifacts = (Path(own) / "mlartifacts").as_uri()  # temporary, like the database
    if tracking_uri is None:
        if folder is None:
            raise TrackingError(
                "mlflow.tracking_uri must be set if storage is not a local folder, "
                f"got storage {redact(storage)}: a bucket cannot hold an SQLite file. "
                "Name an MLflow server."
            )
        database = folder / "mlflow.db"
        return TrackingStore(uri=sqlite_url(database), artifact_root=artifacts, database=database)
    is_server = _checked_scheme(tracking_uri) in _SERVERS
    uri, known = database_url(tracking_uri), database_url(os.environ.get(VARIABLE, ""))
    if redact(known) == uri:  # the sweep has its URI without the password
        uri = known
    if storage.startswith("s3://") and not is_server:
        bucket = urlsplit(storage)
        if bucket.username and bucket.password:
            os.environ.setdefault("AWS_ACCESS_KEY_ID", unquote(bucket.username))
            os.environ.setdefault("AWS_SECRET_ACCESS_KEY", unquote(bucket.password))
        options = dict(parse_qsl(bucket.query))
        if endpoint := options.get("endpoint_override"):  # MLflow writes artifacts there itself
            if "://" not in endpoint:
                endpoint = f"{options.get('scheme', 'https')}://{endpoint}"
            os.environ.setdefault("MLFLOW_S3_ENDPOINT_URL", endpoint)
    return TrackingStore(uri=uri, artifact_root=None if is_server else artifacts)


def check_reachable(store: TrackingStore) -> None:
    """Check that the store's server answers; a database is not checked.

    Raises:
        TrackingError: No MLflow server answers in time.
    """
    if not store.is_server:
        return
    import requests

    reason = None
    try:
        answer = _get(store, "health")
        if answer.status_code == 403 and "host" in answer.text.lower():
            reason = "it refuses this host name; start it with --allowed-hosts naming it"
        elif answer.status_code >= 500:
            reason = f"it answered with status {answer.status_code}"
    except requests.Timeout:
        reason = f"no answer within {CONNECT_SECONDS + ANSWER_SECONDS:.0f} s"
    except (OSError, ValueError) as error:  # also of a certificate or a variable of MLflow
        reason = f"no connection ({_cause(error)})"
    if reason is not None:
        raise TrackingError(
            f"{_origin(store.uri)} must name an MLflow server that answers, got "
            f"{store.public_uri}: {reason}. Start that server, correct the URI, or set it to null "
            "for a local SQLite file."
        )


def _cause(error: BaseException) -> str:
    """The innermost error of a request, such as a refused connection or an unknown host."""
    while error.__context__ is not None:
        error = error.__context__
    return redact(str(error))


def mlflow_version(store: TrackingStore) -> str | None:
    """Version of the MLflow that shows the store; None if a server does not answer."""
    import mlflow

    if not store.is_server:
        return mlflow.__version__
    try:
        answer = _get(store, "version")
        return answer.text.strip() if answer.ok else None
    except (OSError, ValueError):
        return None


def _get(store: TrackingStore, page: str) -> requests.Response:
    import requests
    from mlflow import environment_variables as mlflow_variables
    from mlflow.utils.credentials import get_default_host_creds

    known = get_default_host_creds(store.uri)  # a server may require them for its version
    insecure = mlflow_variables.MLFLOW_TRACKING_INSECURE_TLS.get()
    return requests.get(
        f"{store.uri.rstrip('/')}/{page}",
        timeout=(CONNECT_SECONDS, ANSWER_SECONDS),
        auth=(known.username, known.password) if known.username and known.password else None,
        headers={"Authorization": f"Bearer {known.token}"} if known.token else None,
        verify=not insecure and (mlflow_variables.MLFLOW_TRACKING_SERVER_CERT_PATH.get() or True),
        cert=mlflow_variables.MLFLOW_TRACKING_CLIENT_CERT_PATH.get(),
    )


def _checked_scheme(uri: str) -> str:
    """Scheme of a tracking URI; a TrackingError if MLflow lacks it, or the URI has no host."""
    scheme = uri.partition("://")[0].partition("+")[0] if "://" in uri else ""
    if scheme not in (*_SERVERS, *_DATABASES):
        raise TrackingError(
            f"{_origin(uri)} must be null (an SQLite file in the storage folder), "
            f"http(s)://HOST:PORT or a database URI ({', '.join(_DATABASES)}), got {redact(uri)!r}"
        )
    try:
        parts = urlsplit(uri)
        has_host = bool(parts.hostname) and parts.port != 0
    except ValueError:
        has_host = False
    if scheme in _SERVERS and not has_host:
        raise TrackingError(
            f"{_origin(uri)} must name a host and a numeric port, got {redact(uri)!r}"
        )
    return scheme


def _origin(uri: str) -> str:
    """The setting of this URI, for messages."""
    if uri != database_url(os.environ.get(VARIABLE, "")):
        return SETTING
    return f"{SETTING} (from the environment variable {VARIABLE})"


def follow_moved_storage(database: Path, artifact_root: str) -> None:
    """Correct the artifact URIs in the database of a storage that was moved or copied.

    MLflow records absolute URIs, so it would read and write in the earlier folder.
    """
    root, known = f"{artifact_root}/", "file:%/mlartifacts/%"
    with closing(sqlite3.connect(database, timeout=_LOCK_SECONDS)) as connection, connection:
        if not connection.execute(_OTHER_PLACES, (known, root)).fetchone():
            return
        for table, column in _PLACES:
            connection.execute(
                f"UPDATE {table} SET {column} = ? || "  # noqa: S608 - constants
                f"substr({column}, instr({column}, '/mlartifacts/') + 13) WHERE {column} LIKE ?",
                (root, known),
            )


def empty_database(version: str) -> Path:
    """File in the user's cache with MLflow's tables, which take 2 s of CPU time to create."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "music_rllib", f"mlflow-{version}.db")


def keep_empty_database(database: Path, version: str) -> None:
    """Put an empty copy of a new database into the cache, if it is writable."""
    with contextlib.suppress(OSError, RuntimeError, sqlite3.Error):
        kept = empty_database(version)
        if kept.exists():
            return
        kept.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=kept.parent) as folder:
            copy = Path(folder, "empty.db")
            with (
                closing(sqlite3.connect(database)) as source,
                closing(sqlite3.connect(copy)) as target,
            ):
                source.backup(target)
                # MLflow creates its default experiment again, with this store's artifact folder.
                target.execute("DELETE FROM experiments")
                target.commit()
            copy.replace(kept)
