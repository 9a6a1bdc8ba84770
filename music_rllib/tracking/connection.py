"""Connects to MLflow's store; a new sqlite file starts as a copy of an empty one."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
import warnings
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.version import VERSION

from music_rllib.errors import TrackingError
from music_rllib.tracking.store import TrackingStore

REQUEST_SECONDS = 30
"""Timeout of one request, unless MLFLOW_HTTP_REQUEST_TIMEOUT sets another."""
SCHEMA_SECONDS = 120.0
"""Longest wait for another process that creates the tables of the same sqlite file."""


def configure_mlflow() -> None:
    """Turn off MLflow's own retries and its notices.

    MLflow's retries would block for minutes, and could create a run twice if a response gets
    lost. The sender retries instead, and looks for the run first.
    """
    os.environ["MLFLOW_HTTP_REQUEST_MAX_RETRIES"] = "0"
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", str(REQUEST_SECONDS))
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    # Raised by MLflow's use of SQLAlchemy when its database code is imported.
    warnings.filterwarnings("ignore", r"The ``noload`` loader strategy", DeprecationWarning)
    # Raised by MLflow's own type hints when its model code is imported.
    warnings.filterwarnings("ignore", r".*Any type hint is inferred as AnyType", UserWarning)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    # It logs tracebacks of errors that it also raises, and that the sender logs in one line.
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)


def open_client(store: TrackingStore) -> MlflowClient:
    """Connect to the store. Only one process at a time may create the tables of a sqlite file.

    MLflow's migration crashes if several processes open a new file at once.
    """
    if store.database is None:
        return MlflowClient(store.uri)
    try:
        store.database.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{store.database}.lock", timeout=SCHEMA_SECONDS):
            is_new = not store.database.exists()
            if is_new:
                _copy_empty_database(store.database)
            client = MlflowClient(store.uri)
            client.search_experiments(max_results=1)
            if is_new:
                _keep_empty_database(store.database)
            return client
    except (OSError, TimeoutError) as error:
        raise TrackingError(
            f"{store.database} must be writable for the local MLflow store: {error}. "
            "Choose another storage folder or name a server in mlflow.tracking_uri."
        ) from error


def _empty_database() -> Path:
    """File in the user's cache with this MLflow's tables, which take 2 s of CPU time to create."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "music_rllib", f"mlflow-{VERSION}.db")


def _copy_empty_database(database: Path) -> None:
    """Start a database from the one in the cache, if there is one."""
    with contextlib.suppress(OSError, RuntimeError):
        shutil.copyfile(_empty_database(), database)


def _keep_empty_database(database: Path) -> None:
    """Put an empty copy of a new database into the cache, if it is writable."""
    with contextlib.suppress(OSError, RuntimeError, sqlite3.Error):
        kept = _empty_database()
        if kept.exists():
            return
        kept.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=kept.parent) as folder:
            draft = Path(folder, "empty.db")
            with (
                closing(sqlite3.connect(database)) as source,
                closing(sqlite3.connect(draft)) as target,
            ):
                source.backup(target)
                # MLflow makes its default experiment anew, with the artefact folder of that store.
                target.execute("DELETE FROM experiments")
                target.commit()
            draft.replace(kept)
