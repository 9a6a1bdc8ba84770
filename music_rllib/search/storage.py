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
"""Errors of a database that doesn't answer, or not now."""
SETTING, WARM_SETTING = "search.storage", "search.warm_start.storage"


def open_studies(url: str, *, warm_start: bool = False) -> BaseStorage:
    """Open the storage of a search, which is made where it is missing, or of a warm start.

    Args:
        url: SQLAlchemy's URL, or the path of a sqlite file. PostgreSQL's password comes from
            `PGPASSWORD` or a password file.
        warm_start: The storage must have studies, and nothing is changed in it.

    Raises:
        StorageError: The database can't be reached, or must have studies and does not.
    """
    setting = WARM_SETTING if warm_start else SETTING
    with _saying_what_is_wrong(url, setting):
        parsed = _parsed(url, setting)
        file = _file_of(parsed)
        if warm_start and file is not None and not file.is_file():
            raise StorageError(f"{setting} must be an sqlite file that is there, got {redact(url)}")
        if warm_start and not _has_studies(parsed):
            raise StorageError(f"{setting} must be a database with studies, got {redact(url)}")
        database = _with_tables(parsed, make=not warm_start)
        storage = get_storage(database)  # with a cache of ended trials
        # Optuna leaves its connections open, of which Python >= 3.13 warns.
        weakref.finalize(storage, database.engine.dispose)
        return storage


def known_studies(url: str) -> list[str]:
    """Names of the studies in a search's database, the oldest first; nothing is changed there.

    Args:
        url: As for `open_studies`; the database may be missing.

    Raises:
        StorageError: It can't be reached, or made.
    """
    with _saying_what_is_wrong(url, SETTING):
        parsed = _parsed(url, SETTING)
        file = _file_of(parsed)
        if file is not None and not file.exists():
            if not os.access(file.absolute().parent, os.W_OK | os.X_OK):
                raise StorageError(
                    f"{SETTING} must be in a folder that can be written, got {redact(url)}"
                )
            return []
        return names_of(open_studies(url)) if _has_studies(parsed) else []


def _has_studies(url: URL) -> bool:
    engine = create_engine(url, **_engine_options(url))
    try:
        return inspect(engine).has_table("studies")
    finally:
        engine.dispose()


def studies_of(storage: BaseStorage) -> list[Any]:
    """All studies in a storage, the oldest first."""
    return sorted(storage.get_all_studies(), key=lambda study: int(study._study_id))


def names_of(storage: BaseStorage) -> list[str]:
    """Names of all studies in a storage, the oldest first."""
    return [study.study_name for study in studies_of(storage)]


def same_database(one: str, other: str) -> bool:
    """Whether two URLs or paths name the same database."""
    return _place(one) == _place(other)


def _place(url: str) -> str:
    try:
        file = _file_of(_parsed(url, ""))
    except (ArgumentError, StorageError, RuntimeError):
        return url
    return url if file is None else str(file.resolve())


def _parsed(url: str, setting: str) -> URL:
    parsed = make_url(database_url(url if "://" in url else sqlite_url(Path(url).expanduser())))
    if parsed.password:
        raise StorageError(
            f"{setting} must not hold a password, got one in {redact(url)}: put it into the "
            "environment as PGPASSWORD, or into ~/.pgpass"
        )
    return parsed


def _file_of(url: URL) -> Path | None:
    """The file of a sqlite database; None for any other."""
    in_file = url.get_backend_name() == "sqlite" and url.database not in (None, "", ":memory:")
    return Path(str(url.database)) if in_file else None


def _engine_options(url: URL) -> dict[str, Any]:
    local = url.get_backend_name() == "sqlite"
    # Optuna asks for all unfinished trials by their ids: each number of them is a statement of its
    # own, and sqlite would keep 128 long ones.
    sqlite = {"connect_args": {"timeout": 60, "cached_statements": 8}}
    return {**(sqlite if local else {"pool_size": 2}), "pool_pre_ping": True}


@contextlib.contextmanager
def _saying_what_is_wrong(url: str, setting: str) -> Iterator[None]:
    """Turn errors of the database into one that names the setting.

    Raises:
        StorageError: The database can't be used.
    """
    try:
        yield
    except StorageError:
        raise
    except (*DATABASE_ERRORS, ArgumentError, ImportError, RuntimeError) as error:
        cause = first_line(error.__cause__ or error)
        raise StorageError(
            f"{setting} must be a database that can be used, got {redact(url)}: {redact(cause)}"
        ) from error


def _with_tables(url: URL, *, make: bool) -> RDBStorage:
    """Optuna's storage, its tables made where they are missing if `make` says so.

    Of two drivers that find a new database at the same moment, one fails to make a table that the
    other is just making, and finds it there when it looks again.
    """
    for wait in (0.5, 1.0, 2.0, 4.0, None) if make else (None,):
        try:
            return RDBStorage(
                url.render_as_string(hide_password=False),
                engine_kwargs=_engine_options(url),
                skip_table_creation=not make,
            )
        except (IntegrityError, ProgrammingError):
            if wait is None:
                raise
            time.sleep(wait)
    raise AssertionError("unreachable")
