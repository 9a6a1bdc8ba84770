"""The searches of a sweep: checked before the sweep starts, then opened with their studies."""

from __future__ import annotations

import contextlib
import os
import time
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage, get_storage
from optuna.trial import FrozenTrial
from sqlalchemy import create_engine, inspect
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import (
    ArgumentError,
    IntegrityError,
    OperationalError,
    ProgrammingError,
    SQLAlchemyError,
)

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import Stage, SweepConfig
from music_rllib.config.search import Rung, SearchSettings
from music_rllib.errors import first_line
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node, node_key
from music_rllib.redaction import redact
from music_rllib.results.statistics import Array
from music_rllib.search.study import OptunaStudy
from music_rllib.store.storage import StorageError, database_url, sqlite_url

DATABASE_ERRORS = (StorageInternalError, SQLAlchemyError)
"""Errors of a database that does not answer, or not now."""
SETTING = "search.storage"
STUDY_FILE = "study.db"
"""File in the sweep's folder."""


@dataclass(eq=False)
class RunningTrial:
    """A trial that this driver runs."""

    study: OptunaStudy
    trial: FrozenTrial
    runs: list[Node] = field(default_factory=list)
    """Its runs at the rung."""
    rung: int = 0


@dataclass
class Finalist:
    """A trial that runs again on fresh seeds."""

    number: int
    values: Mapping[str, Any]
    """Its point, with the compared values."""
    searched: tuple[float, ...]
    """Its objective values in the search."""
    runs: list[Node]
    scores: list[Array] | None = None
    """For each objective `[seeds, tasks]` on fresh seeds; None until all runs have ended."""
    failure: str = ""

    @property
    def over(self) -> bool:
        """Whether it has its scores, or can't have them."""
        return self.scores is not None or bool(self.failure)


@dataclass
class Search:
    """A searched stage."""

    stage: Stage
    settings: SearchSettings
    rungs: tuple[Rung, ...]
    """The rungs of a trial; the last one is its end."""
    studies: list[OptunaStudy]
    """A study for each compared value, or one study."""
    running: list[RunningTrial] = field(default_factory=list)
    finalists: list[Finalist] | None = None
    """None until all studies have ended."""
    recalled: set[int] = field(default_factory=set)
    """Ids of the ended trials whose runs are in the plan."""

    @property
    def over(self) -> bool:
        return self.finalists is not None and all(one.over for one in self.finalists)

    def label(self, study: OptunaStudy) -> str:
        """`finetune tac.alpha=0.1`, for messages."""
        values = (f"{name}={value}" for name, value in study.compared.items())
        return " ".join((self.stage.name, *values))


def check_studies(sweep: OpenSweep) -> None:
    """Check that the searches' databases can be used.

    Nothing is created, so that a sweep that is only planned leaves nothing behind.

    Raises:
        StorageError: A database can't be used.
    """
    for stage in sweep.plan.searched:
        assert stage.search is not None
        storage = _place(sweep, stage.search)
        # The sweep's folder may not exist yet.
        if stage.search.storage or Path(storage).exists():
            check_database(storage)


def open_searches(sweep: OpenSweep, *, alone: bool = False) -> list[Search]:
    """Open the studies of a sweep's searched stages; missing studies are created.

    `alone` says that no other driver runs the sweep.

    Raises:
        StorageError: A study's storage can't be used.
    """
    return [_open_search(sweep, stage, alone) for stage in sweep.plan.searched]


def _place(sweep: OpenSweep, settings: SearchSettings) -> str:
    """The database of a search: a URL, or the path of a file."""
    own = Path(os.environ.get(names.VARIABLE_STUDIES) or sweep.folder)
    return settings.storage or str(own / STUDY_FILE)


def _open_search(sweep: OpenSweep, stage: Stage, alone: bool) -> Search:
    settings = stage.search
    assert settings is not None
    sweep.folder.mkdir(parents=True, exist_ok=True)
    place = _place(sweep, settings)
    if settings.storage is None:
        Path(place).parent.mkdir(parents=True, exist_ok=True)
    storage, determined_by = open_studies(place), _determined_by(sweep, stage)
    studies = [
        OptunaStudy(
            storage,
            f"{settings.study or sweep.config.name}/{stage.name}",
            settings,
            determined_by,
            compared=values,
            # Only drivers of this sweep use the file in its folder.
            alone=alone and settings.storage is None,
        )
        for values in settings.compared()
    ]
    rungs = _rungs(sweep, stage, settings)
    return Search(stage=stage, settings=settings, rungs=rungs, studies=studies)


def _rungs(sweep: OpenSweep, stage: Stage, settings: SearchSettings) -> tuple[Rung, ...]:
    seeds, env_steps = len(sweep.plan.seeds), stage.most_env_steps
    end = Rung(seeds=seeds)
    rungs = [
        Rung(
            seeds=rung.seeds or seeds,
            # At the whole budget a run ends, so it is not paused.
            env_steps=None if (rung.env_steps or env_steps) >= env_steps else rung.env_steps,
        )
        for rung in (settings.pruning.rungs if settings.pruning else ())
    ]
    return (*dict.fromkeys(rung for rung in rungs if rung != end), end)


def _determined_by(sweep: OpenSweep, stage: Stage) -> dict[str, Any]:
    """Plain data of the settings that the stage's runs share, except the searched ones."""
    (point,) = stage.points
    sources = list(_sources_of(sweep.config, stage))
    nearest = sources[0] if sources else _SourceData({}, None, None)
    # Values of another environment do not count. The earliest stands for all equal ones.
    runs = (*point.runs.values(), *(run for one in sources for run in one.runs.values()))
    tasks = sorted({run.code for run in runs} & sweep.environments.now.keys())
    environments = {task: sweep.environments.earliest(task) for task in tasks}
    # Only if there are several: studies of earlier versions keep their names.
    further = [one.document() for one in sources[nearest.task is None :]]
    return {
        **({"environments": environments} if environments else {}),
        "seeds": list(sweep.plan.seeds),
        "runs": {task: node_key(run, None) for task, run in point.runs.items()},
        "source": nearest.document()["runs"],
        "checkpoint": nearest.checkpoint,
        **({"sources": further} if further else {}),
    }


class _SourceData(NamedTuple):
    """What a stage's runs start from: settings of runs by task, or the hash of a checkpoint."""

    runs: Mapping[str, RunSettings]
    task: str | None
    checkpoint: str | None

    def document(self) -> dict[str, Any]:
        keys = {task: node_key(run, None) for task, run in self.runs.items()}
        return {"runs": keys, "task": self.task, "checkpoint": self.checkpoint}


def _sources_of(config: SweepConfig, stage: Stage) -> Iterator[_SourceData]:
    """The source of a stage's runs, the source of that one, and so on."""
    own: Stage | None = stage
    while own is not None and (source := own.source) is not None:
        own = config.source_of(own)
        yield _SourceData(
            runs=own.points[0].runs if own else {},
            task=source.task.name if source.task else None,
            checkpoint=source.checkpoint.manifest.content_hash if source.checkpoint else None,
        )


# Databases ----------------------------------------------------------------------------------------


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
            try:
                return _storage(parsed)
            except (IntegrityError, ProgrammingError, OperationalError) as error:
                # The last one is SQLite's; it also means that the database does not answer.
                if isinstance(error, OperationalError) and "already exists" not in str(error):
                    raise
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
    """The parsed URL; a password in it, or a database that can't be used, is a StorageError."""
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
