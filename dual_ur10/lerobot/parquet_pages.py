"""Check of the sizes that a received Parquet file states against its pages, before anything is unpacked.

A page of a few bytes may hold billions of equal values, and the footer of the file may state fewer. The header of a
page decides how many are unpacked. It is a struct in Thrift's compact protocol.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

from dual_ur10.errors import DatasetError

_LARGEST_HEADER: Final = 2**16
_MOST_BYTES: Final = 16  # of a value and its levels, unpacked
_SLACK_BYTES: Final = 2**20
_DATA_PAGES: Final = {0: 5, 3: 8}
"""Field of the page header that describes a page with values, by the type of the page."""

_NUMBERS: Final = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS: Final = (4, 5, 6)


def check_sizes(path: Path, metadata: Any, sizes: Mapping[str, int]) -> int:
    """Return the number of values of some columns, once their pages are known to hold as many as the file states.

    Args:
        path: The file.
        metadata: Its `pyarrow.parquet.FileMetaData`.
        sizes: Values in each row, by the name of the column.

    Raises:
        DatasetError: A column is not of numbers; or the file states another number of values, or its pages hold another
            one.
        OSError: It cannot be read.
    """
    total = 0
    with path.open("rb") as file:
        for number in range(metadata.num_row_groups):
            group = metadata.row_group(number)
            for chunk in map(group.column, range(group.num_columns)):
                path_in_file = f"{chunk.path_in_schema}."
                name = max((each for each in sizes if path_in_file.startswith(f"{each}.")), key=len, default=None)
                if name is None:
                    continue
                if chunk.physical_type not in _NUMBERS:  # a text of any length is one value
                    raise DatasetError(f"{path}, {name} is of type {chunk.physical_type}: expected are numbers")
                expected = group.num_rows * sizes[name]
                found = chunk.num_values if chunk.num_values != expected else _values_in(file, path, chunk)
                if found != expected:
                    raise DatasetError(
                        f"{path}, {name}: the file is damaged, or not as it states: {found} values in "
                        f"{group.num_rows} rows, expected are {sizes[name]} in each. Copy it again"
                    )
                total += expected
    return total


def _values_in(file: BinaryIO, path: Path, chunk: Any) -> int:
    """Return the number of values in the pages of a column, as far as they are read for the number that it states."""
    at, found = chunk.data_page_offset, 0
    if chunk.has_dictionary_page and 0 < chunk.dictionary_page_offset < at:
        at = chunk.dictionary_page_offset
    end = at + chunk.total_compressed_size
    while found < chunk.num_values and at < end:
        file.seek(at)
        try:
            header, length = _struct(file.read(_LARGEST_HEADER), 0)
            values = header[_DATA_PAGES[header[1]]][1] if header[1] in _DATA_PAGES else 0
            if values < 0 or header[3] < 0 or header[2] > _MOST_BYTES * chunk.num_values + _SLACK_BYTES:
                raise ValueError(f"a page of {values} values in {header[3]} bytes, unpacked {header[2]}")
            found += values
            at += length + header[3]
        except (IndexError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise DatasetError(
                f"cannot read {path}: the header of a page is damaged ({error}). Copy it again"
            ) from None
    return found


def _struct(data: bytes, at: int) -> tuple[dict[int, Any], int]:
    """Return the fields of a struct by their numbers, and the place after it."""
    fields: dict[int, Any] = {}
    number = 0
    while (head := data[at]) != _STOP:
        at += 1
        if head >> 4:
            number += head >> 4
        else:
            number, at = _integer(data, at)
        kind = head & 15
        fields[number], at = (kind == _TRUE, at) if kind in (_TRUE, _FALSE) else _value(kind, data, at)
    return fields, at + 1


def _value(kind: int, data: bytes, at: int) -> tuple[Any, int]:
    """Return a value of a kind, and the place after it. Only integers and structs are of use."""
    if kind == _STRUCT:
        return _struct(data, at)
    if kind in _INTEGERS:
        return _integer(data, at)
    if kind in (_TRUE, _FALSE, _BYTE):  # truths are bytes in a list
        return data[at], at + 1
    if kind == _DOUBLE:
        return None, at + _fitting(8, data, at)
    if kind == _BINARY:
        length, at = _count(data, at)
        return None, at + _fitting(length, data, at)
    if kind in (_LIST, _SET):
        head, at = data[at], at + 1
        count, at = _count(data, at) if head >> 4 == 15 else (head >> 4, at)
        for _ in range(_fitting(count, data, at)):  # each takes a byte or more
            _, at = _value(head & 15, data, at)
        return None, at
    raise ValueError(f"a value of kind {kind}")


def _fitting(size: int, data: bytes, at: int) -> int:
    """Return a number of bytes, if so many are left."""
    if size > len(data) - at:
        raise ValueError(f"{size} bytes or values in {len(data) - at} bytes")
    return size


def _count(data: bytes, at: int) -> tuple[int, int]:
    """Return a number without a sign, seven bits in each byte, and the place after it."""
    found = shift = 0
    while shift < 64:
        found |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return found, at
        shift += 7
    raise ValueError("a number of more than 64 bits")


def _integer(data: bytes, at: int) -> tuple[int, int]:
    """Return a number with a sign, which is its last bit, and the place after it."""
    found, at = _count(data, at)
    return (found >> 1) ^ -(found & 1), at
