"""Exports: a sweep as a folder of plain tables, readable without this package.

docs/reports.md describes the files. Exports of several machines, sittings and sweeps can be merged
into one sweep.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field

from music_rllib.errors import reason_of
from music_rllib.experiment.sweep_files import ANALYSIS_PLAN, CONFIG, EXPORT, SEARCH
from music_rllib.limits import (
    MOST_JSON_BYTES,
    MOST_YAML_BYTES,
    read_json,
    read_regular,
)
from music_rllib.names import TAG_FAILURE
from music_rllib.results.analysis_plan import PlanVersion, as_document, checked_plans
from music_rllib.results.data import (
    Column,
    Place,
    ReportError,
    RunRecord,
    Sweep,
    by_metric,
    checked_searches,
    history_of,
    joined,
)
from music_rllib.store.tables import read_table, write_table

Format = Literal["csv", "parquet"]
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

_PLACES = re.compile(r"^( *(?:storage|tracking_uri): (['\"]?))(.+)(\2)$", re.MULTILINE)
_PATHS = re.compile(r"^( *(?:- )*(?:[\w.-]+: )?(['\"]?))((?:file://)?/.+)(\2)$", re.MULTILINE)
"""Values that are absolute paths, such as those of `env_kwargs`."""
_FOLDERS = re.compile(r"(?:file://|(?<![\w:/.~]))/(?:[^\s/'\"]+/)+")
"""The folders above a file in a message."""
_LOCAL = re.compile(r"(sqlite(?:\+\w+)?:///)/(?:.*/)?([^/]+/[^/]+)|(?:file://)?/(?:.*/)?([^/]+)/*")


def _without_folders(place: str) -> str:
    """`place` without the folders above it; servers, buckets and relative paths are kept.

    A sqlite file keeps its own folder, as in `results/mlflow.db`.
    """
    local = _LOCAL.fullmatch(place)
    return local.expand(r"\1\2\3") if local else place


def is_archive(folder: Path) -> bool:
    """Whether `folder` holds an exported sweep, and is not that of a sweep itself."""
    return os.path.lexists(folder / EXPORT) and not os.path.lexists(folder / CONFIG)


def write_archive(sweep: Sweep, folder: Path, file_format: Format = "parquet") -> None:
    """Write `sweep` into `folder`, replacing an earlier export.

    An export may be published, so it does not contain absolute paths of the machine.

    Raises:
        ReportError: The folder is not writable, or holds files of a sweep or of the user.
    """
    tables = [f"{one}.{kind}" for one in ("runs", "metrics") for kind in get_args(Format)]
    own = (CONFIG, EXPORT, *tables, SEARCH, ANALYSIS_PLAN)
    is_ours = is_archive(folder) and _is_header(folder / EXPORT)
    if not is_ours and (found := [name for name in own if os.path.lexists(folder / name)]):
        raise ReportError(
            f"--export must be a new folder or that of an earlier export, got {folder}, which has "
            f"{', '.join(found)}"
        )
    header: dict[str, Any] = {"version": 1, "format": file_format}
    header |= {name: getattr(sweep, name) for name in _OWN_FIELDS}
    header["source"] = _without_folders(sweep.source)
    if sweep.config is not None:
        header["config"] = sweep.config
        for values in (_PLACES, _PATHS):
            header["config"] = values.sub(
                lambda found: found[1] + _without_folders(found[3]) + found[4], header["config"]
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Written to a temporary folder first: a full disk must not destroy an earlier export.
        with TemporaryDirectory(dir=folder, prefix=".new-") as temporary:
            new = Path(temporary)
            write_table(_runs_table(sweep.runs), new / f"runs.{file_format}")
            write_table(metrics_table(sweep), new / f"metrics.{file_format}")
            if sweep.searches:
                _write_json([_without_place(found) for found in sweep.searches], new / SEARCH)
            if sweep.plans:
                _write_json(as_document(sweep.plans), new / ANALYSIS_PLAN)
            _write_json(header, new / EXPORT)
            for stale in (*tables, SEARCH, ANALYSIS_PLAN):
                if not (new / stale).exists():
                    (folder / stale).unlink(missing_ok=True)
            # The header first: without it, what an interruption leaves would not be replaced.
            for file in sorted(new.iterdir(), key=lambda file: file.name != EXPORT):
                file.replace(folder / file.name)
    except OSError as error:
        raise ReportError(f"{folder} must be writable: {error}") from error


def read_archive(folder: Path) -> Sweep:
    """Read an exported sweep.

    Raises:
        ReportError: A file is missing or malformed.
    """
    file = folder / EXPORT
    try:
        header = _Header.model_validate(_read_json(file))
        file = folder / f"runs.{header.format}"
        records = [_record(row) for row in read_table(file, _RUNS).to_pylist()]
        file = folder / f"metrics.{header.format}"
        metrics = read_table(file, _METRICS)
        points = [metrics[name].to_numpy() for name in ("run", "env_steps", "value", "time_ms")]
        run = points[0]
        if len(run) and not 0 <= run.min() <= run.max() < len(records):
            raise ValueError(f"a metric's run must be one of {len(records)}, got {run.max()}")
        history = by_metric(metrics["metric"], Column(*points))
        file = folder / SEARCH
        found = checked_searches(_read_json(file)) if file.exists() else ()
        file = folder / ANALYSIS_PLAN
        plans = checked_plans(_read_json(file)) if file.exists() else ()
    except (OSError, KeyError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
        raise ReportError(
            f"{folder} must hold an exported sweep: {file.name}: {reason_of(error)}"
        ) from error
    own = {name: getattr(header, name) for name in _OWN_FIELDS}
    return Sweep(**own, runs=records, history=history, searches=found, plans=plans)


def _shown(param: str, value: str) -> str:
    """A param, of the task without folders; others tell conditions apart."""
    return _FOLDERS.sub("", value) if param.startswith("task.") else value


def _is_header(file: Path) -> bool:
    """Whether an export, perhaps an interrupted one, wrote this file, which it replaces at once."""
    try:
        header = _read_json(file)
    except (OSError, ValueError):
        return False
    return isinstance(header, dict) and {"version", "format", "source"} <= header.keys()


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


def _without_place(search: Mapping[str, Any]) -> dict[str, Any]:
    storage = search.get("storage")
    return {**search, "storage": None if storage is None else _without_folders(storage)}


def _write_json(document: Any, file: Path) -> None:
    file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _runs_table(runs: Sequence[RunRecord]) -> pa.Table:
    rows = [
        {"run": number}
        | {name: getattr(run, name) for name in _RUN_FIELDS}
        | {f"tag.{name}": value for name, value in run.tags.items()}
        | ({f"tag.{TAG_FAILURE}": _FOLDERS.sub("", run.failure)} if run.failure else {})
        | {f"param.{name}": _shown(name, value) for name, value in run.params.items()}
        for number, run in enumerate(runs)
    ]
    others = sorted({name for row in rows for name in row} - _RUNS.keys())
    schema = pa.schema([*_RUNS.items(), *((name, pa.string()) for name in others)])
    return pa.Table.from_pylist(rows, schema)


def metrics_table(sweep: Sweep) -> pa.Table:
    """Every value of every metric, with the number of its run."""
    every = joined(sweep.history.values())
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


def _record(row: Mapping[str, Any]) -> RunRecord:
    def having(prefix: str) -> dict[str, str]:
        found = (name for name in row if name.startswith(prefix) and row[name] is not None)
        return {name.removeprefix(prefix): row[name] for name in found}

    own = {name: row[name] for name in _RUN_FIELDS if name in row}
    return RunRecord(**own, params=having("param."), tags=having("tag."))


# Merging ------------------------------------------------------------------------------------------


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
    """Each version of a plan once.

    A version is left out if an earlier one of another storage contains it: one sweep was run in
    parts. In one storage it is a change of the plan.
    """
    kept: list[PlanVersion] = []
    versions = [(version, sweep.plans) for sweep in sweeps for version in sweep.plans]
    for version, own in sorted(versions, key=lambda version: version[0].recorded_ms):
        others = (earlier for earlier in kept if earlier not in own)
        if version not in kept and not any(version.plan.is_part_of(one.plan) for one in others):
            kept.append(version)
    return tuple(kept)


def best_records(sweeps: Iterable[Sweep]) -> dict[str, Place]:
    """The last finished run of each node key, else the last that began, else the last one.

    Keys are in the order of their first appearance.
    """
    best: dict[str, Place] = {}
    for sweep in sweeps:
        for position, run in enumerate(sweep.runs):
            other, at = best.get(run.node_key, (sweep, position))
            if _rank(run) >= _rank(other.runs[at]):
                best[run.node_key] = (sweep, position)
    return best


def _rank(run: RunRecord) -> int:
    return 2 if run.is_finished else int(run.status != "SCHEDULED")
