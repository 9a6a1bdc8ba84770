"""Checks of a Parquet file's pages before anything unpacks them.

A page's header says what the page unpacks to, and a compressed one of a few kilobytes may say
gigabytes. Arrow believes it, and neither reads the headers alone nor takes a limit for them.
Format: https://parquet.apache.org/docs/file-format/ (headers in Thrift's compact protocol).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pyarrow import parquet

from music_rllib.limits import (
    MOST_PAGE_BYTES,
    MOST_PAGES,
    MOST_UNPACKED_BYTES,
    MOST_UNPACKED_PER_BYTE,
)

_ENCODINGS = {0: "PLAIN", 2: "PLAIN_DICTIONARY", 3: "RLE", 8: "RLE_DICTIONARY"}
"""Encodings that Arrow writes unless asked. Others hold long texts in next to nothing."""
_UNPACKED, _PACKED = 2, 3
"""Fields of a page header: the sizes of the page."""
_ENCODING_OF = {5: 2, 7: 2, 8: 4}
"""Field that describes a data page, dictionary or newer data page, to its field of the encoding."""


def check_pages(data: memoryview, metadata: parquet.FileMetaData) -> None:
    """Check the sizes that a file's pages unpack to, and that its row groups have all its rows.

    Args:
        data: Content of the file.
        metadata: Metadata from its footer, which may lie.

    Raises:
        ValueError: The file is beyond a limit, or damaged; says how.
    """
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    rows = sum(group.num_rows for group in groups)
    if rows != metadata.num_rows:
        raise ValueError(f"must have as many rows as it says, {metadata.num_rows}, it has {rows}")
    most = MOST_UNPACKED_BYTES + MOST_UNPACKED_PER_BYTE * len(data)
    pages = total = 0
    for group in groups:
        for number in range(group.num_columns):
            for unpacked in _pages(data, group.column(number)):
                pages, total = pages + 1, total + unpacked
                if unpacked > MOST_PAGE_BYTES or total > most or pages > MOST_PAGES:
                    raise ValueError(
                        f"must have at most {MOST_PAGES} pages, of {MOST_PAGE_BYTES} bytes each "
                        f"and {most} together when unpacked: page {pages} has {unpacked}, "
                        f"all so far {total}"
                    )


def _pages(data: memoryview, column: parquet.ColumnChunkMetaData) -> Iterator[int]:
    """Number of bytes that each page of a column unpacks to."""
    at = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < at:
        at = column.dictionary_page_offset
    end = at + column.total_compressed_size
    if not 0 <= at <= end <= len(data):
        raise ValueError(f"{column.path_in_schema} must be inside the file, it isn't")
    try:
        while at < end:
            header, at = _struct(data, at)
            at += header[_PACKED]
            for kind in _ENCODING_OF.keys() & header.keys():
                encoding = header[kind].get(_ENCODING_OF[kind])
                if encoding not in _ENCODINGS:
                    raise ValueError(
                        f"{column.path_in_schema} must be encoded as one of "
                        f"{', '.join(_ENCODINGS.values())}, it is encoding {encoding}"
                    )
            yield header[_UNPACKED]
            if header[_PACKED] < 0 or header[_UNPACKED] < 0:
                raise ValueError(f"{column.path_in_schema} must have pages of 0 bytes or more")
    except (LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{column.path_in_schema} has a damaged page header: {error!r}") from None


def _struct(data: memoryview, at: int) -> tuple[dict[int, Any], int]:
    """The integer and struct fields of a Thrift struct by number, and the position of its end."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        kind = head & 15
        if head >> 4:
            number += head >> 4
        else:
            number, at = _integer(data, at)
        match kind:
            case 1 | 2:  # a boolean is its kind
                pass
            case 3:
                at += 1
            case 4 | 5 | 6:
                fields[number], at = _integer(data, at)
            case 8:  # a text: of statistics
                size, at = _unsigned(data, at)
                at += size
            case 12:
                fields[number], at = _struct(data, at)
            case _:
                raise ValueError(f"a page header must have no field of Thrift's type {kind}")
    return fields, at + 1


def _integer(data: memoryview, at: int) -> tuple[int, int]:
    value, at = _unsigned(data, at)
    return (value >> 1) ^ -(value & 1), at


def _unsigned(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
        if shift > 63:
            raise ValueError("a number in a page header must have at most 64 bits")
