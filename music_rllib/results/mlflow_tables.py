"""The runs of a sweep out of MLflow's sqlite file, without MLflow, which takes seconds to load.

The tables `experiments`, `runs`, `tags` and `params` are the same since MLflow 1.0. Whatever is
otherwise than it is known here is left to MLflow's client.
"""

from __future__ import annotations

import functools
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, urlsplit
from urllib.request import url2pathname

from music_rllib import names
from music_rllib.limits import MOST_JSON_BYTES, read_regular
from music_rllib.results.data import RunRecord


class FoundRuns(NamedTuple):
    """A sweep's own run and those of its nodes."""

    experiment_id: str
    parent: RunRecord
    children: list[RunRecord]
    artefact: Callable[[str], str | None]
    """A text of the sweep's own run, by its name; None where it has none."""


def read_tables(file: Path, name: str, sweep_id: str | None) -> FoundRuns | None:
    """The newest sweep of this name; None where MLflow itself has to be asked.

    Args:
        file: MLflow's.
        name: of the sweep's experiment.
        sweep_id: of the sweep; None for the one that began last.
    """
    try:
        with closing(sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)) as tables:
            return _found(tables, name, sweep_id)
    except (sqlite3.Error, ValueError):
        return None


def _found(tables: sqlite3.Connection, name: str, sweep_id: str | None) -> FoundRuns | None:
    experiments = tables.execute(
        "SELECT experiment_id FROM experiments WHERE name = ?", (name,)
    ).fetchall()
    if len(experiments) != 1:  # of several workspaces, or none
        return None
    experiment = experiments[0][0]
    wanted = {names.TAG_KIND: names.KIND_SWEEP}
    if sweep_id is not None:
        wanted[names.TAG_SWEEP_ID] = sweep_id
    parents = _runs(tables, experiment, wanted)
    if not parents:
        return None
    parent = max(parents, key=lambda run: run.started or 0)
    (place,) = tables.execute(
        "SELECT artifact_uri FROM runs WHERE run_uuid = ?", (parent.run_id,)
    ).fetchone()
    folder = _local(place)
    children = _runs(tables, experiment, {names.TAG_PARENT_RUN: parent.run_id})
    if folder is None:
        return None
    return FoundRuns(str(experiment), parent, children, functools.partial(_text, folder))


def _text(folder: Path, name: str) -> str | None:
    try:
        return read_regular(folder / name, MOST_JSON_BYTES).decode("utf-8")
    except OSError:
        return None


def _local(uri: str) -> Path | None:
    parts = urlsplit(uri)
    return Path(url2pathname(parts.path)) if parts.scheme in ("", "file") else None


def _runs(
    tables: sqlite3.Connection, experiment: int, wanted: Mapping[str, str]
) -> list[RunRecord]:
    """Those that have these tags, in the order in which they began."""
    with_tags = " ".join(
        f"JOIN tags t{i} ON t{i}.run_uuid = r.run_uuid AND t{i}.key = ? AND t{i}.value = ?"
        for i in range(len(wanted))
    )
    chosen = f"FROM runs r {with_tags} WHERE r.experiment_id = ? AND r.lifecycle_stage = 'active'"
    values = [*(part for item in wanted.items() for part in item), experiment]
    found = tables.execute(
        f"SELECT r.run_uuid, r.name, r.status, r.start_time, r.end_time {chosen} "
        "ORDER BY r.start_time IS NULL, r.start_time, r.run_uuid",
        values,
    ).fetchall()
    query = "SELECT c.run_uuid, c.key, c.value FROM {} c WHERE c.run_uuid IN ({}) ORDER BY c.rowid"
    params, tags = (
        _by_run(tables.execute(query.format(table, f"SELECT r.run_uuid {chosen}"), values))
        for table in ("params", "tags")
    )
    return [
        RunRecord(
            run_id=run_id,
            name=tags.get(run_id, {}).get(names.TAG_LABEL) or name or run_id,
            status=status,
            started=started,
            ended=ended,
            params=params.get(run_id, {}),
            tags=tags.get(run_id, {}),
        )
        for run_id, name, status, started, ended in found
    ]


def _by_run(rows: Iterable[tuple[str, str, str]]) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for run, key, value in rows:
        found.setdefault(run, {})[key] = value
    return found
