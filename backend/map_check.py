"""Is a map file whole? Every page, every reference and every checksum."""

import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from seamark.backend.errors import MapCorruptError
from seamark.backend.map_adjustments import decode_adjusted
from seamark.backend.map_codec import (
    check_row,
    decode_array,
    decode_camera,
    decode_features,
    decode_loop,
    decode_span,
    row_name,
)
from seamark.backend.map_file import MapFile
from seamark.backend.map_schema import COLUMNS, select

MOST_PROBLEMS = 1000


@dataclass(frozen=True)
class CheckReport:
    """``rows`` read per table, and ``problems`` in words, at most MOST_PROBLEMS of them; none: the map is whole."""

    rows: dict[str, int]
    problems: tuple[str, ...]


def check_map(path: Path, progress: Callable[[int, int], None] | None = None) -> CheckReport:
    """Read all of a map; raises MapError for a file that cannot be read as one."""
    file = MapFile(path, read_only=True)
    problems: list[str] = []
    rows: dict[str, int] = {}
    try:
        with file.reading() as database:
            for pragma, what in (("integrity_check", "page"), ("foreign_key_check", "reference")):
                try:
                    found = [tuple(row) for row in database.execute(f"PRAGMA {pragma}")]
                except sqlite3.DatabaseError as error:
                    found = [(str(error),)]
                problems += [f"{what}: {' '.join(map(str, row))}" for row in found if row != ("ok",)]
        for done, table in enumerate(COLUMNS):
            rows[table] = _check_table(file, table, problems)
            if progress is not None:
                progress(done + 1, len(COLUMNS))
    finally:
        file.close()
    return CheckReport(rows, tuple(problems[:MOST_PROBLEMS]))


def _check_table(file: MapFile, table: str, problems: list[str]) -> int:
    count = 0
    with file.reading() as database:
        try:
            for row in database.execute(select(table)):
                count += 1
                try:
                    check_row(table, row)
                    _decode(table, row)
                except (MapCorruptError, ValueError, KeyError, TypeError) as error:
                    problems.append(f"{row_name(table, tuple(row))}: {error}")
        except sqlite3.DatabaseError as error:
            problems.append(f"table {table} after {count} rows: {error}")
    return count


def _decode(table: str, row: sqlite3.Row) -> None:
    """Decode what a row holds: a right checksum of nonsense would be a bug of ours."""
    if table == "features":
        features = decode_features(row)
        lengths = {len(features.points), len(features.scales), len(features.angles), len(features.descriptors)}
        if len(lengths) != 1:
            raise ValueError(f"features of different lengths {sorted(lengths)}")
    elif table == "spans":
        decode_span(row)
    elif table == "loops":
        decode_loop(row)
    elif table == "cameras":
        decode_camera(row["model"])
    elif table == "images":
        decode_array(row["thumbnail"])
    elif table == "adjusted":
        decode_adjusted(row)
    elif table in ("edges", "keyframes", "landmarks", "poses", "views"):
        names = (name for name in row.keys() if name not in ("checksum", "file"))  # noqa: SIM118 (no mapping)
        for value in (row[name] for name in names):
            decode_array(value if isinstance(value, bytes) else None)
