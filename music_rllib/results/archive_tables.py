"""Tables of an exported sweep as CSV or Parquet files, which may come from strangers."""

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
"""Number of rows that a file of any size may have."""
_FIRST_BYTES = 1 << 20
"""Number of bytes in which a CSV file's first line ends."""
_BATCH_ROWS = 65_536
"""Rows of a Parquet file that are read before the length of its texts is checked."""
_ENCODINGS = {"PLAIN", "PLAIN_DICTIONARY", "RLE", "RLE_DICTIONARY", "BIT_PACKED"}
"""Encodings that Arrow writes by default; others store long texts in almost no bytes."""
_MAY_BE_EMPTY = ("started", "ended")


def write_table(table: pa.Table, file: Path) -> None:
    """Write a table in the format of the file's ending."""
    if file.suffix == ".csv":
        csv.write_csv(table, file)
    else:
        with parquet.ParquetWriter(file, table.schema, compression="zstd") as writer:
            if table.num_rows:  # a group without rows says that its pages lie at the file's start
                writer.write_table(table)


def read_table(file: Path, kinds: Mapping[str, pa.DataType]) -> pa.Table:
    """Read a table and check it against a schema, as far as possible before it takes memory.

    Args:
        file: A `.csv` or Parquet file.
        kinds: Types of the columns that there must be, by name; others are text.

    Raises:
        OSError: The file can't be read.
        ValueError: The table has other columns, or is larger than its file can hold.
        pyarrow.ArrowException: The file is damaged.
    """
    with open_regular(file) as source:
        head, size = source.read(_FIRST_BYTES), os.fstat(source.fileno()).st_size
    # By Arrow's own threads, which can't wait for Python's at the end of a process.
    with pa.OSFile(str(file)) as native:
        if file.suffix == ".csv":
            table = _from_csv(native, head, kinds)
        else:
            table = _from_parquet(native, size)
    missing = [name for name in kinds if name not in table.column_names]
    if missing:
        raise ValueError(f"must have the column {missing[0]}, it has {table.column_names[:9]}")
    if len(set(table.column_names)) < table.num_columns:
        raise ValueError("its columns must have different names")
    names = table.column_names
    schema = pa.schema([(name, kinds.get(name, pa.string())) for name in names])
    table = table.cast(schema)
    for name in kinds:
        if table[name].null_count and name not in _MAY_BE_EMPTY:
            raise ValueError(f"{name} must be given in each row, it is not")
    return table


def _check_size(rows: int, columns: int, size: int) -> None:
    most = min(MOST_TABLE_ROWS, _FREE_ROWS + MOST_ROWS_PER_BYTE * size)
    if rows > most:
        raise ValueError(f"must have at most {most} rows in {size} bytes, it says {rows}")
    if columns > MOST_COLUMNS:
        raise ValueError(f"must have at most {MOST_COLUMNS} columns, it has {columns}")


def _characters(batch: pa.RecordBatch) -> int:
    """Characters of all texts; a text that a dictionary repeats counts at each of its uses."""
    texts = (column for column in batch.columns if isinstance(column, pa.DictionaryArray))
    lengths = (compute.binary_length(text.dictionary).take(text.indices) for text in texts)
    return sum(compute.sum(length).as_py() or 0 for length in lengths)


def _check_metadata(metadata: parquet.FileMetaData, size: int) -> None:
    """Check the sizes in a Parquet file's footer."""
    _check_size(metadata.num_rows, metadata.num_columns, size)
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    if (rows := sum(group.num_rows for group in groups)) != metadata.num_rows:
        raise ValueError(f"must have as many rows as it says, {metadata.num_rows}, it has {rows}")
    columns = [group.column(i) for group in groups for i in range(group.num_columns)]
    for column in columns:
        if others := {*column.encodings} - _ENCODINGS:
            raise ValueError(
                f"{column.path_in_schema} must be encoded as {', '.join(sorted(_ENCODINGS))}, "
                f"it is {', '.join(sorted(others))}"
            )
    unpacked = [column.total_uncompressed_size for column in columns]
    most = MOST_UNPACKED_BYTES + MOST_UNPACKED_PER_BYTE * size
    if sum(unpacked) > most or min(unpacked, default=0) < 0:
        raise ValueError(f"must have at most {most} bytes when unpacked, it has {sum(unpacked)}")


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
            raise ValueError(f"{field.name} must be text or numbers, it is {field.type}")
    # As dictionaries, so that a text that stands in each row is read once.
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    source.seek(0)
    batches, total = [], 0
    reader = parquet.ParquetFile(source, read_dictionary=texts, **limits)
    for batch in reader.iter_batches(_BATCH_ROWS):
        batches.append(batch)
        total += _characters(batch)
        if total > MOST_TABLE_TEXT:  # before the next batch: the footer may lie
            raise ValueError(f"must have at most {MOST_TABLE_TEXT} characters of text")
    return pa.Table.from_batches(batches, reader.schema_arrow if not batches else None)


def _from_csv(source: pa.NativeFile, head: bytes, kinds: Mapping[str, pa.DataType]) -> pa.Table:
    first, _, _ = head.partition(b"\n")
    _check_size(0, first.count(b",") + 1, 0)
    names = csv.read_csv(pa.BufferReader(first + b"\n")).column_names
    convert = csv.ConvertOptions(
        column_types={name: kinds.get(name, pa.string()) for name in names},
        # An empty field is nothing, an empty text in quotes is a text, and nan is a number.
        null_values=[""],
        strings_can_be_null=True,
        quoted_strings_can_be_null=False,
    )
    # A failure's text has line breaks.
    return csv.read_csv(
        source,
        convert_options=convert,
        parse_options=csv.ParseOptions(newlines_in_values=True),
    )
