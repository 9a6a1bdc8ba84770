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
from sqlalchemy import create_engine, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, ProgrammingError, SQLAlchemyError

from music_rllib.errors import first_line
from music_rllib.redaction import redact
from music_rllib.store.storage import StorageError, database_url, sqlite_url

DATABASE_ERRORS = (StorageInternalError, SQLAlchemyError)
"""Errors of a database that does not answer, or not now."""
SETTING, WARM_SETTING = "search.storage", "search.warm_start.storage"


def open_studies(url: str, *, warm_start: bool = False) -> BaseStorage:
    """Open the storage of a search, which is created if it does not exist, or of a warm start.

    Args:
        url: SQLAlchemy's URL, or the path of an SQLite file. PostgreSQL's password comes from
            `PGPASSWORD` or a password file.
        warm_start: Whether it is the storage of a warm start, which must have studies.

    Raises:
        StorageError: The database can't be reached, or must have studies and does not.
    """
    if warm_start:
        known_studies(url, warm_start=True)
    with _checked(url, WARM_SETTING if warm_start else SETTING) as parsed:
        # If two drivers find a new database at the same moment, one fails to create a table that
        # the other is creating, and finds it when it tries again.
        for wait in (0.5, 1.0, 2.0, 4.0):
            with contextlib.suppress(IntegrityError, ProgrammingError):
                return _storage(parsed)
            time.sleep(wait)
        return _storage(parsed)


def known_studies(url: str, *, warm_start: bool = False) -> list[str]:
    """Names of the studies in a database, the oldest first; changes nothing there.

    Args:
        url: As for `open_studies`; the database of a search may be missing.
        warm_start: Whether it is the storage of a warm start, which must have studies.

    Raises:
        StorageError: It can't be reached, can't be created, or must have studies and does not.
    """
    setting = WARM_SETTING if warm_start else SETTING
    with _checked(url, setting) as parsed:
        file = _file_of(parsed)
        if file is not None and not file.is_file():
            if warm_start:
                raise StorageError(f"{setting} must be an existing SQLite file, got {redact(url)}")
            if not os.access(file.absolute().parent, os.W_OK | os.X_OK):
                raise StorageError(
                    f"{setting} must be in a folder that can be written, got {redact(url)}"
                )
            return []
        engine = create_engine(parsed, **_engine_options(parsed))
        try:
            if inspect(engine).has_table("studies"):
                with engine.connect() as connection:
                    found = connection.execute(
                        text("SELECT study_name FROM studies ORDER BY study_id")
                    )
                    return [str(name) for name in found.scalars()]
        finally:
            engine.dispose()
        if warm_start:
            raise StorageError(f"{setting} must be a database with studies, got {redact(url)}")
        return []


def studies_of(storage: BaseStorage) -> list[Any]:
    """All studies in a storage, the oldest first."""
    return sorted(storage.get_all_studies(), key=lambda study: int(study._study_id))


@contextlib.contextmanager
def _checked(url: str, setting: str) -> Iterator[URL]:
    """The parsed URL; errors of the database become errors that name the setting.

    Raises:
        StorageError: The URL has a password, or the database can't be used.
    """
    try:
        parsed = make_url(database_url(url if "://" in url else sqlite_url(Path(url).expanduser())))
        if parsed.password:
            raise StorageError(
                f"{setting} must not hold a password, got one in {redact(url)}: put it into the "
                "environment as PGPASSWORD, or into ~/.pgpass"
            )
        yield parsed
    except StorageError:
        raise
    except (*DATABASE_ERRORS, ArgumentError, ImportError, RuntimeError) as error:
        cause = first_line(error.__cause__ or error)
        raise StorageError(
            f"{setting} must be a database that can be used, got {redact(url)}: {redact(cause)}"
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
