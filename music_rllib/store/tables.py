"""Tables of an export, which may come from strangers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import compute, csv, parquet

from music_rllib.limits import (
    MOST_COLUMNS,
    MOST_ROWS_PER_BYTE,
    MOST_TABLE_ROWS,
    MOST_TABLE_TEXT,
    MOST_UNPACKED_BYTES,
    MOST_UNPACKED_PER_BYTE,
    open_regular,
)

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
