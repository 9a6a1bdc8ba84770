"""The databases of Optuna's studies."""

from __future__ import annotations

import contextlib
import os
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage, get_storage
from sqlalchemy import create_engine, inspect
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, ProgrammingError, SQLAlchemyError

from music_rllib.errors import first_line
from music_rllib.redaction import redact
from music_rllib.store.storage import StorageError, database_url, sqlite_url

DATABASE_ERRORS = (StorageInternalError, SQLAlchemyError)
"""Errors of a database that does not answer, or not now."""
SETTING = "search.storage"


def open_studies(url: str) -> BaseStorage:
    """Open the storage of a search, which is created if it does not exist.

    Args:
        url: SQLAlchemy's URL, or the path of an SQLite file. PostgreSQL's password comes from
            `PGPASSWORD` or a password file.

    Raises:
        StorageError: The database can't be reached.
    """
    with _checked(url) as parsed:
        # If two drivers find a new database at the same moment, one fails to create a table that
        # the other is creating, and finds it when it tries again.
        for wait in (0.5, 1.0, 2.0, 4.0):
            with contextlib.suppress(IntegrityError, ProgrammingError):
                return _storage(parsed)
            time.sleep(wait)
        return _storage(parsed)


def check_database(url: str) -> None:
    """Check that a database can be used, or be created; changes nothing there.

    Raises:
        StorageError: It can't.
    """
    with _checked(url) as parsed:
        file = _file_of(parsed)
        if file is not None and not file.is_file():
            if not os.access(file.absolute().parent, os.W_OK | os.X_OK):
                raise StorageError(
                    f"{SETTING} must be in a folder that can be written, got {redact(url)}"
                )
            return
        engine = create_engine(parsed, **_engine_options(parsed))
        try:
            inspect(engine).has_table("studies")
        finally:
            engine.dispose()


@contextlib.contextmanager
def _checked(url: str) -> Iterator[URL]:
    """The parsed URL; errors of the database become errors that name the setting.

    Raises:
        StorageError: The URL has a password, or the database can't be used.
    """
    try:
        parsed = make_url(database_url(url if "://" in url else sqlite_url(Path(url).expanduser())))
        if parsed.password:
            raise StorageError(
                f"{SETTING} must not hold a password, got one in {redact(url)}: put it into the "
                "environment as PGPASSWORD, or into ~/.pgpass"
            )
        yield parsed
    except StorageError:
        raise
    except (*DATABASE_ERRORS, ArgumentError, ImportError, RuntimeError) as error:
        cause = first_line(error.__cause__ or error)
        raise StorageError(
            f"{SETTING} must be a database that can be used, got {redact(url)}: {redact(cause)}"
        ) from error


def _file_of(url: URL) -> Path | None:
    """The file of an SQLite database; None for any other."""
    in_file = url.get_backend_name() == "sqlite" and url.database not in (None, "", ":memory:")
    return Path(str(url.database)) if in_file else None


def _engine_options(url: URL) -> dict[str, Any]:
    if url.get_backend_name() != "sqlite":
        return {"pool_size": 2, "pool_pre_ping": True}
    # Optuna reads all unfinished trials by their ids. Each number of trials is another statement,
    # and SQLite would cache 128 of these long statements.
    return {"connect_args": {"timeout": 60, "cached_statements": 8}, "pool_pre_ping": True}


def _storage(url: URL) -> BaseStorage:
    """Optuna's storage; missing tables are created."""
    text_of_url = url.render_as_string(hide_password=False)
    database = RDBStorage(text_of_url, engine_kwargs=_engine_options(url))
    storage = get_storage(database)  # with a cache of ended trials
    # Optuna leaves its connections open, and Python >= 3.13 prints a warning about them.
    weakref.finalize(storage, database.engine.dispose)
    return storage
