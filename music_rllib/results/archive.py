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
from pyarrow import compute, csv, parquet
from pydantic import BaseModel, ConfigDict, Field

from music_rllib.errors import reason_of
from music_rllib.experiment.sweep_files import CONFIG
from music_rllib.limits import (
    MOST_COLUMNS,
    MOST_JSON_BYTES,
    MOST_ROWS_PER_BYTE,
    MOST_TABLE_ROWS,
    MOST_TABLE_TEXT,
    MOST_UNPACKED_BYTES,
    MOST_UNPACKED_PER_BYTE,
    MOST_YAML_BYTES,
    open_regular,
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

_FREE_ROWS = 100_000
"""Number of rows allowed in a file of any size."""
_FIRST_BYTES = 1 << 20
"""Number of bytes that contain the first line of a CSV file."""
_BATCH_ROWS = 65_536
"""Rows of a Parquet file that are read before the length of its texts is checked."""
_ENCODINGS = {"PLAIN", "PLAIN_DICTIONARY", "RLE", "RLE_DICTIONARY", "BIT_PACKED"}
"""Encodings that Arrow writes by default; others can store long texts in almost no bytes."""
_MAY_BE_EMPTY = ("started", "ended", "trained_seconds")
_MAY_BE_MISSING = ("trained_seconds",)
"""Columns that old exports lack."""

_PLACES = re.compile(r"^( *(?:storage|tracking_uri): (['\"]?))(.+)(\2)$", re.MULTILINE)
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
    return os.path.lexists(folder / _HEADER) and not os.path.lexists(folder / CONFIG)


def write_archive(sweep: Sweep, folder: Path, file_format: Format = "parquet") -> None:
    """Write `sweep` into `folder`, replacing an earlier export.

    An export may be published, so it does not contain absolute paths of the machine.

    Raises:
        ReportError: The folder is not writable, or holds files of a sweep or of the user.
    """
    tables = [f"{one}.{kind}" for one in ("runs", "metrics") for kind in get_args(Format)]
    own = (CONFIG, _HEADER, *tables, _SEARCHES, _PLANS)
    if not is_archive(folder) and (found := [name for name in own if (folder / name).exists()]):
        raise ReportError(
            f"--export must be a new folder or that of an earlier export, got {folder}, which has "
            f"{', '.join(found)}"
        )
    header: dict[str, Any] = {"version": 1, "format": file_format}
    header |= {name: getattr(sweep, name) for name in _OWN_FIELDS}
    header["source"] = _without_folders(sweep.source)
    if sweep.config is not None:
        header["config"] = _PLACES.sub(
            lambda found: found[1] + _without_folders(found[3]) + found[4], sweep.config
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Written to a temporary folder first: a full disk must not destroy an earlier export.
        with TemporaryDirectory(dir=folder, prefix=".new-") as temporary:
            new = Path(temporary)
            write_table(_runs_table(sweep.runs), new / f"runs.{file_format}")
            write_table(metrics_table(sweep), new / f"metrics.{file_format}")
            if sweep.searches:
                _write_json([_without_place(found) for found in sweep.searches], new / _SEARCHES)
            if sweep.plans:
                _write_json(as_document(sweep.plans), new / _PLANS)
            _write_json(header, new / _HEADER)
            for stale in (*tables, _SEARCHES, _PLANS):
                if not (new / stale).exists():
                    (folder / stale).unlink(missing_ok=True)
            # The header first: without it, what an interruption leaves would not be replaced.
            for file in sorted(new.iterdir(), key=lambda file: file.name != _HEADER):
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
        records = [_record(row) for row in read_table(file, _RUNS).to_pylist()]
        file = folder / f"metrics.{header.format}"
        metrics = read_table(file, _METRICS)
        points = [metrics[name].to_numpy() for name in ("run", "env_steps", "value", "time_ms")]
        run = points[0]
        if len(run) and not 0 <= run.min() <= run.max() < len(records):
            raise ValueError(f"a metric's run must be one of {len(records)}, got {run.max()}")
        history = by_metric(metrics["metric"], Column(*points))
        file = folder / _SEARCHES
        found = checked_searches(_read_json(file)) if file.exists() else ()
        file = folder / _PLANS
        plans = checked_plans(_read_json(file)) if file.exists() else ()
    except (OSError, KeyError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
        raise ReportError(
            f"{folder} must hold an exported sweep: {file.name}: {reason_of(error)}"
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
        | {f"param.{name}": value for name, value in run.params.items()}
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


# Tables, which may come from strangers ------------------------------------------------------------


def write_table(table: pa.Table, file: Path) -> None:
    """Write a table in the format of the file's ending."""
    if file.suffix == ".csv":
        csv.write_csv(table, file)
    else:
        with parquet.ParquetWriter(file, table.schema, compression="zstd") as writer:
            if table.num_rows:  # an empty row group would point to pages at the start of the file
                writer.write_table(table)


def read_table(file: Path, kinds: Mapping[str, pa.DataType]) -> pa.Table:
    """Read a table and check it against a schema, as far as possible before it takes memory.

    Args:
        file: A `.csv` or Parquet file.
        kinds: Types of the required columns, by name; other columns are text.

    Raises:
        OSError: The file can't be read.
        ValueError: A column is missing, or the table is too large for its file.
        pyarrow.ArrowException: The file is damaged.
    """
    with open_regular(file) as source:
        head, size = source.read(_FIRST_BYTES), os.fstat(source.fileno()).st_size
    # Arrow's own threads can't wait for Python's at the end of a process.
    with pa.OSFile(str(file)) as native:
        if file.suffix == ".csv":
            table = _from_csv(native, head, kinds)
        else:
            table = _from_parquet(native, size)
    missing = kinds.keys() - {*table.column_names, *_MAY_BE_MISSING}
    if missing:
        raise ValueError(f"must have the column {min(missing)}, got {table.column_names[:9]}")
    if len(set(table.column_names)) < table.num_columns:
        raise ValueError("must have columns with different names")
    names = table.column_names
    schema = pa.schema([(name, kinds.get(name, pa.string())) for name in names])
    table = table.cast(schema)
    for name in kinds:
        if name not in _MAY_BE_EMPTY and table[name].null_count:
            raise ValueError(f"{name} must have a value in each row")
    return table


def _check_size(rows: int, columns: int, size: int) -> None:
    most = min(MOST_TABLE_ROWS, _FREE_ROWS + MOST_ROWS_PER_BYTE * size)
    if rows > most:
        raise ValueError(f"must have at most {most} rows in {size} bytes, got {rows}")
    if columns > MOST_COLUMNS:
        raise ValueError(f"must have at most {MOST_COLUMNS} columns, got {columns}")


def _characters(batch: pa.RecordBatch) -> int:
    """Number of characters of all texts; a text in a dictionary counts at each use."""
    texts = (column for column in batch.columns if isinstance(column, pa.DictionaryArray))
    lengths = (compute.binary_length(text.dictionary).take(text.indices) for text in texts)
    return sum(compute.sum(length).as_py() or 0 for length in lengths)


def _check_metadata(metadata: parquet.FileMetaData, size: int) -> None:
    """Check the sizes in a Parquet file's footer."""
    _check_size(metadata.num_rows, metadata.num_columns, size)
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    if (rows := sum(group.num_rows for group in groups)) != metadata.num_rows:
        raise ValueError(f"must have {metadata.num_rows} rows, as its footer states, got {rows}")
    columns = [group.column(i) for group in groups for i in range(group.num_columns)]
    for column in columns:
        if others := {*column.encodings} - _ENCODINGS:
            raise ValueError(
                f"{column.path_in_schema} must be encoded as {', '.join(sorted(_ENCODINGS))}, "
                f"got {', '.join(sorted(others))}"
            )
    unpacked = [column.total_uncompressed_size for column in columns]
    most = MOST_UNPACKED_BYTES + MOST_UNPACKED_PER_BYTE * size
    if sum(unpacked) > most or min(unpacked, default=0) < 0:
        raise ValueError(f"must have at most {most} bytes when unpacked, got {sum(unpacked)}")


def _from_parquet(source: pa.NativeFile, size: int) -> pa.Table:
    limits: dict[str, Any] = {
        "thrift_string_size_limit": 16 << 20,
        "thrift_container_size_limit": 1_000_000,
    }
    footer = parquet.ParquetFile(source, **limits)
    _check_metadata(footer.metadata, size)
    schema = footer.schema_arrow
    for field in schema:
        plain = pa.types.is_string(field.type) or pa.types.is_large_string(field.type)
        if not (plain or pa.types.is_primitive(field.type) or pa.types.is_null(field.type)):
            raise ValueError(f"{field.name} must be text or numbers, got {field.type}")
    # Dictionaries keep a text that is repeated in every row only once.
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    source.seek(0)
    batches, total = [], 0
    reader = parquet.ParquetFile(source, read_dictionary=texts, **limits)
    for batch in reader.iter_batches(_BATCH_ROWS):
        batches.append(batch)
        total += _characters(batch)
        if total > MOST_TABLE_TEXT:  # checked after each batch: the footer may be wrong
            raise ValueError(f"must have at most {MOST_TABLE_TEXT} characters of text")
    return pa.Table.from_batches(batches, reader.schema_arrow if not batches else None)


def _from_csv(source: pa.NativeFile, head: bytes, kinds: Mapping[str, pa.DataType]) -> pa.Table:
    first, _, _ = head.partition(b"\n")
    _check_size(0, first.count(b",") + 1, 0)
    names = csv.read_csv(pa.BufferReader(first + b"\n")).column_names
    convert = csv.ConvertOptions(
        column_types={name: kinds.get(name, pa.string()) for name in names},
        # An empty field is null, an empty text in quotes is a text, and nan is a number.
        null_values=[""],
        strings_can_be_null=True,
        quoted_strings_can_be_null=False,
    )
    # The text of a failure has line breaks.
    return csv.read_csv(
        source,
        convert_options=convert,
        parse_options=csv.ParseOptions(newlines_in_values=True),
    )


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
