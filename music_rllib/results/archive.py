"""Exports: a sweep as a folder of plain tables, readable without this package.

`sweep.json`
    Name, status, tags and configuration of the sweep.
`runs.csv` or `runs.parquet`
    One row per run: its number, its key, and a column per tag (`tag.`) and param (`param.`).
`metrics.csv` or `metrics.parquet`
    One row per value: number of the run, metric, environment steps, value, time in ms.
`search.json`
    For a search: trials, importance of settings, ranking on fresh seeds.
`analysis_plan.json`
    For a sweep with a plan: its versions, each with the time at which it was recorded.

Exports of several machines, sittings and sweeps can be merged into one sweep.
"""

from __future__ import annotations

import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from music_rllib.config.problems import shown
from music_rllib.errors import first_line
from music_rllib.limits import MOST_JSON_BYTES, MOST_YAML_BYTES, read_json, read_regular
from music_rllib.results.analysis_plan import PlanVersion, as_document, checked_plans
from music_rllib.results.archive_tables import read_table, write_table
from music_rllib.results.data import (
    Column,
    History,
    ReportError,
    RunRecord,
    Sweep,
    checked_searches,
    joined,
)

Format = Literal["csv", "parquet"]
_HEADER, _SEARCHES, _PLANS = "sweep.json", "search.json", "analysis_plan.json"
_OWN_FIELDS = ("name", "status", "started", "source", "tags", "config")
_RUNS = {
    "run": pa.int64(),
    **dict.fromkeys(("run_id", "name", "status"), pa.string()),
    **dict.fromkeys(("started", "ended"), pa.int64()),
    "trained_seconds": pa.float64(),
}
"""Columns of the table of runs; other columns are text."""
_RUN_FIELDS = tuple(name for name in _RUNS if name != "run")
_METRICS = {
    "run": pa.int64(),
    "metric": pa.string(),
    "env_steps": pa.int64(),
    "value": pa.float64(),
    "time_ms": pa.int64(),
}
"""Columns of the table of metrics."""

_PLACES = re.compile(r"^(?P<name> *(?:storage|tracking_uri): )(?P<place>.+)$", re.MULTILINE)
_LOCAL = re.compile(r"(sqlite(?:\+\w+)?:///)/(?:.*/)?([^/]+/[^/]+)|(?:file://)?/(?:.*/)?([^/]+)/*")


def _without_folders(place: str) -> str:
    """`place` without the folders above it; servers, buckets and relative paths are kept.

    A sqlite file keeps its own folder, as in `results/mlflow.db`.
    """
    local = _LOCAL.fullmatch(place)
    return local.expand(r"\1\2\3") if local else place


def is_archive(folder: Path) -> bool:
    """Whether `folder` holds an exported sweep."""
    return os.path.lexists(folder / _HEADER)


def write_archive(sweep: Sweep, folder: Path, file_format: Format = "parquet") -> None:
    """Write `sweep` into `folder`, replacing an earlier export.

    An export may be published, so it does not contain absolute paths of the machine.

    Raises:
        ReportError: The folder is not writable.
    """
    header: dict[str, Any] = {"version": 1, "format": file_format}
    header |= {name: getattr(sweep, name) for name in _OWN_FIELDS}
    header["source"] = _without_folders(sweep.source)
    if sweep.config is not None:
        header["config"] = _PLACES.sub(
            lambda found: found["name"] + _without_folders(found["place"]), sweep.config
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Written to a temporary folder first: a full disk must not destroy an earlier export.
        with TemporaryDirectory(dir=folder, prefix=".new-") as temporary:
            new = Path(temporary)
            write_table(_runs_table(sweep.runs), new / f"runs.{file_format}")
            write_table(_metrics_table(sweep), new / f"metrics.{file_format}")
            if sweep.searches:
                _write_json([_without_place(found) for found in sweep.searches], new / _SEARCHES)
            if sweep.plans:
                _write_json(as_document(sweep.plans), new / _PLANS)
            _write_json(header, new / _HEADER)
            tables = [f"{one}.{kind}" for one in ("runs", "metrics") for kind in get_args(Format)]
            for stale in (*tables, _SEARCHES, _PLANS):
                if not (new / stale).exists():
                    (folder / stale).unlink(missing_ok=True)
            for file in new.iterdir():
                file.replace(folder / file.name)
    except OSError as error:
        raise ReportError(f"{folder} must be writable: {error}") from error


def read_archive(folder: Path) -> Sweep:
    """Read an exported sweep.

    Raises:
        ReportError: A file is missing or malformed.
    """
    file = folder / _HEADER
    try:
        header = _Header.model_validate(_read_json(file))
        file = folder / f"runs.{header.format}"
        runs = read_table(file, _RUNS)
        records = _records(runs)
        file = folder / f"metrics.{header.format}"
        metrics = read_table(file, _METRICS)
        history = _history(metrics, runs.num_rows)
        file = folder / _SEARCHES
        found = checked_searches(_read_json(file)) if file.exists() else ()
        file = folder / _PLANS
        plans = checked_plans(_read_json(file)) if file.exists() else ()
    except (OSError, KeyError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
        raise ReportError(
            f"{folder} must hold an exported sweep: {file.name}: {_reason(error)}"
        ) from error
    own = {name: getattr(header, name) for name in _OWN_FIELDS}
    return Sweep(**own, runs=records, history=history, searches=found, plans=plans)


class _Header(BaseModel):
    """Content of `sweep.json`."""

    model_config = ConfigDict(strict=True)

    version: Literal[1]
    format: Format
    name: str
    status: str
    started: int | None = Field(ge=0, lt=2**47)  # until the year 6429
    source: str
    tags: dict[str, str]
    config: str | None = Field(max_length=MOST_YAML_BYTES)


def _read_json(file: Path) -> Any:
    return read_json(read_regular(file, MOST_JSON_BYTES))


def _reason(error: Exception) -> str:
    """The first finding, in one line."""
    if isinstance(error, ValidationError):
        finding = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in finding["loc"])
        rule = finding["msg"].replace("Input should", "must")
        return f"{place} {rule}, got {shown(finding['input'])}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"must have {error}" if isinstance(error, KeyError) else first_line(error)


def _without_place(search: Mapping[str, Any]) -> dict[str, Any]:
    storage = search.get("storage")
    return {**search, "storage": None if storage is None else _without_folders(storage)}


def _write_json(document: Any, file: Path) -> None:
    file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _runs_table(runs: Sequence[RunRecord]) -> pa.Table:
    table: dict[str, Any] = {"run": pa.array(range(len(runs)), pa.int64())}
    for name in _RUN_FIELDS:
        table[name] = pa.array([getattr(run, name) for run in runs], _RUNS[name])
    table |= _wide("tag.", [run.tags for run in runs])
    table |= _wide("param.", [run.params for run in runs])
    return pa.table(table)


def _wide(prefix: str, rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    keys = sorted({key for row in rows for key in row})
    return {prefix + key: pa.array([row.get(key) for row in rows], pa.string()) for key in keys}


def _metrics_table(sweep: Sweep) -> pa.Table:
    every = joined(list(sweep.history.values()))
    metric = [pa.repeat(name, len(column.run)) for name, column in sweep.history.items()]
    return pa.table(
        {
            "run": every.run,
            "metric": pa.chunked_array(metric, pa.string()),
            "env_steps": every.step,
            "value": every.value,
            "time_ms": every.time,
        }
    )


def _records(table: pa.Table) -> list[RunRecord]:
    return [
        RunRecord(
            **{name: row[name] for name in _RUN_FIELDS if name in row},
            params=_narrow("param.", row),
            tags=_narrow("tag.", row),
        )
        for row in table.to_pylist()
    ]


def _narrow(prefix: str, row: Mapping[str, Any]) -> dict[str, str]:
    return {
        name.removeprefix(prefix): value
        for name, value in row.items()
        if name.startswith(prefix) and value is not None
    }


def _history(table: pa.Table, runs: int) -> dict[str, Column]:
    metrics = table["metric"].combine_chunks().dictionary_encode()
    codes = metrics.indices.to_numpy(zero_copy_only=False)
    every = Column(*(table[name].to_numpy() for name in ("run", "env_steps", "value", "time_ms")))
    run = every.run
    if len(run) and not 0 <= run.min() <= run.max() < runs:
        raise ValueError(f"a metric's run must be one of {runs}, got {run.min()} to {run.max()}")
    order = np.lexsort((every.step, run, codes))
    ends = np.searchsorted(codes[order], np.arange(len(metrics.dictionary) + 1))
    return {
        name: every.select(order[ends[code] : ends[code + 1]])
        for code, name in enumerate(metrics.dictionary.to_pylist())
    }


# Merging ------------------------------------------------------------------------------------------

Place = tuple[Sweep, int]
"""An export, and the position of a run in it."""


def merged(earlier: Sweep, later: Sweep) -> Sweep:
    """All runs of two exports of a sweep.

    Runs with the same node key are the same run: the key hashes everything that determines their
    numbers. Of two records of a run, a finished one is kept, else the later one. The fields of the
    sweep come from `later`, and the searches from the last export that has any.
    """
    places = list(best_records([earlier, later]).values())
    return replace(
        later,
        runs=[sweep.runs[position] for sweep, position in places],
        history=history_of(places),
        searches=later.searches or earlier.searches,
        plans=plan_versions([earlier, later]),
    )


def plan_versions(sweeps: Iterable[Sweep]) -> tuple[PlanVersion, ...]:
    """Each version of a plan once, without later ones for a subset of the seeds."""
    kept: list[PlanVersion] = []
    versions = (version for sweep in sweeps for version in sweep.plans)
    for version in sorted(versions, key=lambda version: version.recorded_ms):
        if not any(version.plan.is_part_of(earlier.plan) for earlier in kept):
            kept.append(version)
    return tuple(kept)


def best_records(sweeps: Iterable[Sweep]) -> dict[str, Place]:
    """The last finished run of each node key, else the last one, in order of first appearance."""
    best: dict[str, Place] = {}
    for sweep in sweeps:
        for position, run in enumerate(sweep.runs):
            other, at = best.get(run.node_key, (sweep, position))
            if run.is_finished or not other.runs[at].is_finished:
                best[run.node_key] = (sweep, position)
    return best


def history_of(places: Sequence[Place]) -> History:
    """Metrics of the runs at `places`, numbered in that order."""
    parts: defaultdict[str, list[Column]] = defaultdict(list)
    for number, (sweep, position) in enumerate(places):
        for metric in sweep.history:
            part = sweep.column(position, metric)
            if len(part.run):
                parts[metric].append(replace(part, run=np.full_like(part.run, number)))
    return {metric: joined(parts[metric]) for metric in sorted(parts)}
