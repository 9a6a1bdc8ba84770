"""A sweep read from MLflow in bulk.

MLflow's client answers one metric of one run at a time, some milliseconds each: minutes for a
large sweep. Where the store is a database, the values are read from its `metrics` table instead,
which is the same since MLflow 1.0; everything else goes through the client.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from filelock import FileLock

from music_rllib import names
from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_JSON_BYTES, read_json, read_regular
from music_rllib.results.claims.plan import checked_plans
from music_rllib.results.data import Column, Points, ReportError, RunRecord, Sweep, columns
from music_rllib.results.mlflow_tables import SweepRuns, read_tables, sweep_tags
from music_rllib.results.searches import checked_searches
from music_rllib.tracking.store import TrackingStore, check_reachable

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Run
    from sqlalchemy import Connection


RUNS_PER_PAGE = 1000
REQUESTS_AT_ONCE = 8
READERS = 4
"""Largest number of processes that read the values; more would wait for one disk."""
TABLES_SECONDS = 60.0
_LARGEST = float(np.finfo(np.float64).max)
"""Number that MLflow's databases hold in place of infinity."""


def read_mlflow(
    store: TrackingStore,
    name: str,
    *,
    sweep_id: str | None = None,
    metrics: Collection[str] | None = None,
    processes: Executor | None = None,
) -> Sweep:
    """Read the newest sweep of this name.

    Args:
        store: MLflow's store.
        name: the sweep's name, which is that of its experiment.
        sweep_id: tells sweeps of the same name apart; None for the one that began last.
        metrics: names of the metrics to read; None for all.
        processes: processes that read the values ahead.

    Raises:
        ReportError: where there is no such sweep.
        TrackingError: where the store does not answer.
    """
    ahead = _read_values_ahead(processes, store, sweep_id, metrics)
    file = _sqlite_file(store)
    try:
        if file is not None and file.is_file() and (found := read_tables(file, name, sweep_id)):
            return _sweep(store, name, found, _from_database(store, found, metrics, ahead))
        client = _open(store)
        experiment_id, parent = _parent(client, store, name, sweep_id)
        runs = _search(client, experiment_id, {names.TAG_PARENT_RUN: parent.run_id})
        artefact = functools.partial(_artefact, client, parent.run_id)
        found = SweepRuns(experiment_id, parent, [_record(run) for run in runs], artefact)
        if store.is_server:
            history = columns(_from_server(client, runs, metrics))
        else:
            history = _from_database(store, found, metrics, ahead)
        return _sweep(store, name, found, history)
    except BadInputError:
        raise
    except Exception as error:
        raise _refusal(store, f"answer questions about the sweep {name!r}", error) from error


def _sweep(store: TrackingStore, name: str, found: SweepRuns, history: dict[str, Column]) -> Sweep:
    parent, artefact = found.parent, found.artefact
    return Sweep(
        name=name,
        status=parent.status,
        run_id=parent.run_id,
        experiment_id=found.experiment_id,
        started=parent.started,
        source=store.public_uri,
        tags=parent.tags,
        config=artefact(names.ARTEFACT_SWEEP_CONFIG),
        runs=found.children,
        history=history,
        searches=checked_searches(read_json(artefact(names.ARTEFACT_SEARCH) or "[]")),
        plans=checked_plans(read_json(artefact(names.ARTEFACT_ANALYSIS_PLAN) or "[]")),
    )


def attach(
    store: TrackingStore, run_id: str, folder: Path, files: Iterable[str], name: str, note: str
) -> None:
    """Log `files` of `folder` as artefacts of a run, below `name`, and show `note` on its page.

    Raises:
        ReportError: where MLflow does not take them.
        TrackingError: where the store does not answer.
    """
    client = _open(store)
    try:
        with tempfile.TemporaryDirectory() as copy:  # all at once, and nothing else of the folder
            for file in files:
                target = Path(copy, file)
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(folder / file, target)
            client.log_artifacts(run_id, copy, name)
        client.set_tag(run_id, names.TAG_NOTE, note)
    except Exception as error:
        raise _refusal(store, "take the report", error) from error


def _refusal(store: TrackingStore, rule: str, error: Exception) -> ReportError:
    from music_rllib.tracking.mlflow_client import (
        mlflow_reason,  # with MLflow, which is loaded by now
    )

    return ReportError(
        f"MLflow at {store.public_uri} must {rule}, it answered: {mlflow_reason(error)}"
    )


def download_policy(
    store: TrackingStore, experiment_id: str, run_id: str, folder: Path
) -> Path | None:
    """Download the policy that is logged as a run's model into `folder`; None without one."""
    client = _open(store)
    import mlflow

    models = client.search_logged_models(
        [experiment_id], f"tags.`{names.TAG_SOURCE_RUN}` = '{run_id}'", max_results=1
    )
    if not models or models[0].status != "READY":
        return None
    place = f"{models[0].artifact_location}/artifacts/{names.ARTEFACT_POLICY}"
    return Path(
        mlflow.artifacts.download_artifacts(
            artifact_uri=place, dst_path=str(folder), tracking_uri=store.uri
        )
    )


def _open(store: TrackingStore) -> MlflowClient:
    """A client of a store that exists; for another, MLflow would make a new, empty file."""
    file = _sqlite_file(store)
    if file is not None and not file.is_file():
        raise ReportError(
            f"{file} must be the sqlite file that a sweep was logged to, and there is none. "
            "Name the sweep's folder, or its storage with --storage, or --tracking-uri."
        )
    check_reachable(store)
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    for chatty in ("mlflow.store.db.utils", "alembic"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    from mlflow import MlflowClient

    if file is not None and (lock := Path(f"{file}.lock")).exists():
        # A sweep that begins may be making the tables, and two at a time crash MLflow's migration.
        with contextlib.suppress(OSError), FileLock(lock, timeout=TABLES_SECONDS):
            return MlflowClient(store.uri)
    return MlflowClient(store.uri)


def _sqlite_file(store: TrackingStore) -> Path | None:
    if not store.uri.startswith("sqlite"):
        return None
    return Path(unquote(store.uri.partition(":///")[2].partition("?")[0]))


def _parent(
    client: MlflowClient, store: TrackingStore, name: str, sweep_id: str | None
) -> tuple[str, RunRecord]:
    """The id of the sweep's experiment, and the sweep's own run."""
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        others = sorted(e.name for e in client.search_experiments() if e.name != "Default")
        there = f"It has: {', '.join(others)}." if others else "It has none."
        raise ReportError(f"{name!r} must be a sweep in MLflow at {store.public_uri}. {there}")
    experiment_id = str(experiment.experiment_id)
    parents = _search(client, experiment_id, sweep_tags(sweep_id))
    if not parents:
        which = "" if sweep_id is None else f" with the id {sweep_id}"
        raise ReportError(
            f"the experiment {name!r} must hold a sweep's own run{which} (tag "
            f"{names.TAG_KIND}={names.KIND_SWEEP}), and holds none: no sweep was logged to it"
        )
    return experiment_id, _record(max(parents, key=lambda run: run.info.start_time or 0))


def _search(client: MlflowClient, experiment_id: str, tags: Mapping[str, str]) -> list[Run]:
    """All runs with these tags, in the order in which they began."""
    from mlflow.utils import get_results_from_paginated_fn

    wanted = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
    order = ["attributes.start_time ASC"]
    runs: list[Run] = get_results_from_paginated_fn(  # type: ignore[no-untyped-call]
        lambda most, token: client.search_runs(
            [experiment_id], wanted, max_results=most, order_by=order, page_token=token
        ),
        RUNS_PER_PAGE,
    )
    return runs


def _record(run: Run) -> RunRecord:
    return RunRecord(
        run_id=run.info.run_id,
        name=run.data.tags.get(names.TAG_LABEL) or run.info.run_name or run.info.run_id,
        status=run.info.status,
        started=run.info.start_time,
        ended=run.info.end_time,
        params=dict(run.data.params),
        tags=dict(run.data.tags),
    )


def _artefact(client: MlflowClient, run_id: str, name: str) -> str | None:
    from mlflow.exceptions import MlflowException

    with tempfile.TemporaryDirectory() as folder:
        try:
            file = client.download_artifacts(run_id, name, folder)
            return read_regular(file, MOST_JSON_BYTES).decode("utf-8")
        except (MlflowException, OSError):
            return None


def _from_database(
    store: TrackingStore,
    found: SweepRuns,
    metrics: Collection[str] | None,
    ahead: Sequence[Future[dict[str, Points]]],
) -> dict[str, Column]:
    """The metrics of the runs; values that were not read ahead are read now."""
    known: dict[str, Points] = {}
    with contextlib.suppress(Exception):  # then it is read here, with a message if that fails
        for part in ahead:
            known |= part.result()
    run_ids = [run.run_id for run in found.children]
    with _database(store.uri) as connection:
        return columns(
            known[run] if run in known else _values(connection, run, metrics) for run in run_ids
        )


def _read_values_ahead(
    processes: Executor | None,
    store: TrackingStore,
    sweep_id: str | None,
    metrics: Collection[str] | None,
) -> list[Future[dict[str, Points]]]:
    """Begin to read the values of a sweep with a known id; empty where they can't be read."""
    file = _sqlite_file(store)
    absent = file is not None and not file.is_file()
    if processes is None or sweep_id is None or store.is_server or absent:
        return []
    parts = min(len(os.sched_getaffinity(0)), READERS)
    try:
        return [
            processes.submit(_values_of_share, store.uri, sweep_id, metrics, part, parts)
            for part in range(parts)
        ]
    except BrokenExecutor:
        return []


def _values_of_share(
    uri: str, sweep_id: str, metrics: Collection[str] | None, part: int, parts: int
) -> dict[str, Points]:
    """The values of every `parts`th run of a sweep from run number `part` on, by run id."""
    import sqlalchemy as sql

    tags = sql.table("tags", *map(sql.column, ("run_uuid", "key", "value")))
    run, sweep = tags.alias("run"), tags.alias("sweep")
    runs = (
        sql.select(run.c.run_uuid)
        .join(sweep, sweep.c.run_uuid == run.c.value)
        .where(run.c.key == names.TAG_PARENT_RUN)
        .where(sweep.c.key == names.TAG_SWEEP_ID, sweep.c.value == sweep_id)
        .order_by(run.c.run_uuid)
    )
    with _database(uri) as connection:
        run_ids = connection.execute(runs).scalars().all()
        return {run_id: _values(connection, run_id, metrics) for run_id in run_ids[part::parts]}


@contextlib.contextmanager
def _database(uri: str) -> Iterator[Connection]:
    import sqlalchemy as sql

    engine = sql.create_engine(uri)
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()


def _values(connection: Connection, run_id: str, metrics: Collection[str] | None) -> Points:
    """The values of one run, in an order that the table's index has."""
    import sqlalchemy as sql

    plain = ("run_uuid", "key", "step", "timestamp", "value")
    table = sql.table("metrics", *map(sql.column, plain), sql.column("is_nan", sql.Boolean))
    run, metric, step, time, value, is_nan = table.c
    known = sql.case((is_nan, sql.null()), else_=value)
    chosen = sql.select(metric, step, time, known).where(run == run_id).order_by(metric, step)
    if metrics is not None:
        chosen = chosen.where(metric.in_(sorted(metrics)))
    # The driver's own cursor: SQLAlchemy's row objects take twice as long.
    cursor: Any = connection.connection.cursor()
    query = chosen.compile(connection.engine, compile_kwargs={"literal_binds": True})
    cursor.execute(str(query))
    return _points(cursor)


_ROW = np.dtype([("metric", "O"), ("step", "i8"), ("time", "i8"), ("value", "f8")])


def _points(rows: Iterable[Sequence[Any]]) -> Points:
    """Points from (metric, step, time, value) rows, sorted by the first two; None is NaN."""
    table = np.fromiter(rows, dtype=_ROW)  # while they are read: lists of them take twice as long
    values = table["value"]
    values[np.abs(values) == _LARGEST] *= np.inf
    counts = Counter(table["metric"].tolist())
    # One string of each name: those of the rows are as many objects, which processes would send.
    metrics = [metric for metric, count in counts.items() for _ in range(count)]
    return Points(metrics, table["step"], table["time"], values)


def _from_server(
    client: MlflowClient, runs: Sequence[Run], metrics: Collection[str] | None
) -> Iterator[Points]:
    wanted = [
        (run.info.run_id, metric)
        for run in runs
        for metric in run.data.metrics
        if metrics is None or metric in metrics
    ]
    by_run: dict[str, list[Metric]] = {run.info.run_id: [] for run in runs}
    with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        histories = pool.map(lambda pair: client.get_metric_history(*pair), wanted)
        for (run_id, _), history in zip(wanted, histories, strict=True):
            by_run[run_id] += history
    for points in by_run.values():
        yield _points(sorted((p.key, p.step, p.timestamp, p.value) for p in points))
