"""Rows out of the pages of a damaged SQLite file, without its tables: the last resort of a repair.

The format is public and frozen (sqlite.org/fileformat2.html). Only leaves of table b-trees are read, wherever they lie;
a row is taken for one of a table when it has as many columns and its last one is the checksum of the rest and the
table's name. So neither the schema nor the inner pages of a tree need to be whole.
"""

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from seamark.backend.map_codec import checksum
from seamark.backend.map_schema import COLUMNS

LEAF: Final = 0x0D
HEADER: Final = b"SQLite format 3\0"
MOST_PAYLOAD: Final = 1 << 28
_INTEGER_SIZES: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
#: Tables whose first column is the row's number, which SQLite does not store a second time.
_BY_NUMBER: Final = tuple(
    table for table in COLUMNS if table not in ("meta", "loops", "evidence", "composed", "adjusted_loops")
)
#: SQLite stores whole numbers of these columns as integers.
REALS: Final = {
    "poses": ("scale",),
    "loops": ("score", "votes", "jeffrey", "scale"),
    "spans": ("angle", "length"),
    "composed": ("scale_sigma",),
    "adjusted": ("scale",),
    "adjusted_loops": ("weight",),
}


class _NoRowError(Exception):
    """The bytes are no row, or not a whole one."""


def carve(path: Path) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield (table, values without checksum) of every whole row in a file, stale copies included.

    Pages that the file calls free come last: what is in them was deleted, or has been written elsewhere since.
    """
    if path.stat().st_size == 0:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        yield from _rows(content, _page_size(content))


def _rows(content: mmap.mmap, size: int) -> Iterator[tuple[str, tuple[Any, ...]]]:
    by_columns: dict[int, list[str]] = {}
    for table, columns in COLUMNS.items():
        by_columns.setdefault(len(columns) + 1, []).append(table)
    free = _free_pages(content, size)
    starts = [*range(0, len(content), size)]
    for start in sorted(starts, key=lambda start: start // size + 1 in free):
        page = bytes(content[start : start + size])
        for number, payload in _cells(content, page, start, size):
            try:
                values = _record(payload)
            except (_NoRowError, UnicodeDecodeError, IndexError, struct.error):
                continue
            for table in by_columns.get(len(values), ()):
                row = _row_of(table, number, values[:-1])
                if checksum(table, row) == values[-1]:
                    yield table, row
                    break


def _row_of(table: str, number: int, values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a row as SQLite would: with its number, and whole numbers of real columns as what they are."""
    if table in _BY_NUMBER and values[0] is None:
        values = (number, *values[1:])
    reals = REALS.get(table, ())
    return tuple(
        float(value) if name in reals and isinstance(value, int) else value
        for name, value in zip(COLUMNS[table], values, strict=True)
    )


def _free_pages(content: mmap.mmap, size: int) -> set[int]:
    """Return the numbers of the pages in the list of free ones, as far as it can be followed."""
    found: set[int] = set()
    if len(content) < 36 or bytes(content[:16]) != HEADER:
        return found
    (trunk,) = struct.unpack(">I", content[32:36])
    while trunk and trunk not in found and trunk * size <= len(content):
        found.add(trunk)
        start = (trunk - 1) * size
        following, count = struct.unpack(">II", content[start : start + 8])
        if count <= size // 4 - 2:
            found |= set(struct.unpack(f">{count}I", content[start + 8 : start + 8 + 4 * count]))
        trunk = following
    return found


def _page_size(content: mmap.mmap) -> int:
    """Return the page size that the header names, SQLite's default if there is none."""
    if len(content) > 18 and bytes(content[:16]) == HEADER:
        size = struct.unpack(">H", content[16:18])[0]
        size = 65536 if size == 1 else size
        if size >= 512 and size & (size - 1) == 0:
            return int(size)
    return 4096


def _cells(content: mmap.mmap, page: bytes, start: int, size: int) -> Iterator[tuple[int, bytes]]:
    """Yield the row numbers and payloads of a leaf; nothing for any other page."""
    at = 100 if start == 0 else 0
    if len(page) < size or page[at] != LEAF:
        return
    (count,) = struct.unpack_from(">H", page, at + 3)
    for index in range(min(count, (size - at - 8) // 2)):
        (offset,) = struct.unpack_from(">H", page, at + 8 + 2 * index)
        try:
            length, offset = _varint(page, offset)
            number, offset = _varint(page, offset)
            if 0 < length < MOST_PAYLOAD:
                yield number - (1 << 64 if number >= 1 << 63 else 0), _payload(content, page, offset, length, size)
        except (IndexError, _NoRowError):
            continue


def _payload(content: mmap.mmap, page: bytes, offset: int, length: int, size: int) -> bytes:
    """Return a payload, following its overflow pages."""
    most, least = size - 35, (size - 12) * 32 // 255 - 23
    if length <= most:
        local = length
    else:
        local = least + (length - least) % (size - 4)
        local = local if local <= most else least
    pieces, missing = [page[offset : offset + local]], length - local
    if len(pieces[0]) < local:
        raise _NoRowError
    if missing:
        following = struct.unpack(">I", page[offset + local : offset + local + 4].ljust(4, b"\0"))[0]
    while missing:
        begin = (following - 1) * size
        if following == 0 or begin + size > len(content):
            raise _NoRowError
        take = min(missing, size - 4)
        pieces.append(bytes(content[begin + 4 : begin + 4 + take]))
        missing -= take
        following = struct.unpack(">I", content[begin : begin + 4])[0]
    return b"".join(pieces)


def _record(payload: bytes) -> tuple[Any, ...]:
    """Return the columns of a record."""
    header_size, at = _varint(payload, 0)
    if not 1 < header_size <= min(len(payload), 200):
        raise _NoRowError
    types = []
    while at < header_size:
        kind, at = _varint(payload, at)
        types.append(kind)
    values = []
    for kind in types:
        value, at = _value(payload, at, kind)
        values.append(value)
    return tuple(values)


def _value(payload: bytes, at: int, kind: int) -> tuple[Any, int]:
    if kind == 0:
        return None, at
    if kind in (8, 9):
        return kind - 8, at
    if kind == 7:
        return struct.unpack_from(">d", payload, at)[0], at + 8
    if kind in _INTEGER_SIZES:
        size = _INTEGER_SIZES[kind]
        return int.from_bytes(payload[at : at + size], "big", signed=True), at + size
    if kind < 12:
        raise _NoRowError
    size = (kind - 12) // 2
    data = payload[at : at + size]
    if len(data) < size:
        raise _NoRowError
    return (data if kind % 2 == 0 else data.decode()), at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number of one to nine bytes, and where it ends."""
    value = 0
    for index in range(8):
        byte = data[at + index]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + index + 1
    return value << 8 | data[at + 8], at + 9
