"""The runs of a sweep read from MLflow's sqlite file without MLflow, which takes seconds to load.

The tables `experiments`, `runs`, `tags` and `params` are the same since MLflow 1.0. Where anything
differs from what is expected here, MLflow's client reads it instead.
"""

from __future__ import annotations

import functools
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, urlsplit
from urllib.request import url2pathname

from music_rllib import names
from music_rllib.limits import MOST_JSON_BYTES, read_regular
from music_rllib.results.data import RunRecord


class SweepRuns(NamedTuple):
    """A sweep's own run and the runs of its nodes."""

    experiment_id: str
    parent: RunRecord
    children: list[RunRecord]
    artefact: Callable[[str], str | None]
    """Reads a text artefact of the sweep's own run by its name; None where it has none."""


def sweep_tags(sweep_id: str | None) -> dict[str, str]:
    """Tags of the own run of the sweep with this id, or with any."""
    own = {} if sweep_id is None else {names.TAG_SWEEP_ID: sweep_id}
    return {names.TAG_KIND: names.KIND_SWEEP, **own}


def read_tables(file: Path, name: str, sweep_id: str | None) -> SweepRuns | None:
    """The newest sweep of this name; None where MLflow's client has to read it.

    Args:
        file: MLflow's sqlite file.
        name: that of the sweep's experiment.
        sweep_id: tells sweeps of the same name apart; None for the one that began last.
    """
    try:
        with closing(sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)) as tables:
            return _sweep_runs(tables, name, sweep_id)
    except (sqlite3.Error, ValueError):
        return None


def _sweep_runs(tables: sqlite3.Connection, name: str, sweep_id: str | None) -> SweepRuns | None:
    experiments = tables.execute(
        "SELECT experiment_id FROM experiments WHERE name = ?", (name,)
    ).fetchall()
    if len(experiments) != 1:  # of several workspaces, or none
        return None
    experiment = experiments[0][0]
    parents = _runs(tables, experiment, sweep_tags(sweep_id))
    if not parents:
        return None
    parent = max(parents, key=lambda run: run.started or 0)
    (artefacts,) = tables.execute(
        "SELECT artifact_uri FROM runs WHERE run_uuid = ?", (parent.run_id,)
    ).fetchone()
    place = urlsplit(artefacts)
    if place.scheme not in ("", "file"):
        return None
    artefact = functools.partial(_text, Path(url2pathname(place.path)))
    children = _runs(tables, experiment, {names.TAG_PARENT_RUN: parent.run_id})
    return SweepRuns(str(experiment), parent, children, artefact)


def _text(folder: Path, name: str) -> str | None:
    try:
        return read_regular(folder / name, MOST_JSON_BYTES).decode("utf-8")
    except OSError:
        return None


def _runs(
    tables: sqlite3.Connection, experiment: int, wanted: Mapping[str, str]
) -> list[RunRecord]:
    """The runs that have these tags, in the order in which they began."""
    with_tags = " ".join(
        f"JOIN tags t{i} ON t{i}.run_uuid = r.run_uuid AND t{i}.key = ? AND t{i}.value = ?"
        for i in range(len(wanted))
    )
    chosen = f"FROM runs r {with_tags} WHERE r.experiment_id = ? AND r.lifecycle_stage = 'active'"
    values = [*(part for item in wanted.items() for part in item), experiment]
    runs = tables.execute(
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
            name=tags[run_id].get(names.TAG_LABEL) or name or run_id,
            status=status,
            started=started,
            ended=ended,
            params=params[run_id],
            tags=tags[run_id],
        )
        for run_id, name, status, started, ended in runs
    ]


def _by_run(rows: Iterable[tuple[str, str, str]]) -> defaultdict[str, dict[str, str]]:
    values: defaultdict[str, dict[str, str]] = defaultdict(dict)
    for run, key, value in rows:
        values[run][key] = value
    return values
