"""What is whole in a damaged map, in a new file."""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from seamark.backend.errors import MapCorruptError, MapError
from seamark.backend.map_carve import carve
from seamark.backend.map_codec import checksum, decode_array, encode_array, motion_between, row_name, sealed
from seamark.backend.map_file import MapFile
from seamark.backend.map_migrations import V1_COLUMNS, checksum_v1, convert_v1
from seamark.backend.map_new import new_map
from seamark.backend.map_schema import COLUMNS, KEYS, select, upsert

BATCH: Final = 200
ADDED: Final = {3: ("views", "spans", "composed"), 4: ("depths",), 5: ("adjusted", "adjusted_loops")}  # by version
OF_KEYFRAME: Final = ("edges", "features", "landmarks", "images", "poses", "views", "depths", "spans", "adjusted")


@dataclass
class RepairReport:
    """``saved`` rows per table. ``damaged`` names rows that were found broken, ``lost`` says in words what is missing
    from the new file, ``mended`` what was made up from the rest.
    """

    saved: dict[str, int] = field(default_factory=dict)
    damaged: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    mended: list[str] = field(default_factory=list)


def repair_map(path: Path, out: Path) -> RepairReport:
    """Write all that is whole in ``path``, which stays as it is, to the new file ``out``.

    Raises MapError when ``out`` exists or nothing could be saved.
    """
    if not path.exists():
        raise MapError(f"there is no map at {path}")
    if path.is_dir():
        raise MapError(f"{path} is a folder, and a map is a file")
    try:
        path.open("rb").close()
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror}") from error
    report = RepairReport()
    with new_map(out, "repair") as partial:
        with closing(MapFile(partial)) as file:
            with file.reading() as database:
                database.execute("PRAGMA foreign_keys = OFF")  # until _mend has seen to them
                database.execute("PRAGMA synchronous = OFF")  # the rename at the end makes it count
            _save(path, file, report)
            with file.writing() as database:
                _mend(database, report)
                broken = database.execute("PRAGMA foreign_key_check").fetchall()
            with file.reading() as database:
                for table in COLUMNS:
                    report.saved[table] = database.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
        if broken or not report.saved["keyframes"]:
            raise MapError(f"nothing could be saved of {path}")
    return report


def _save(path: Path, file: MapFile, report: RepairReport) -> None:
    """Copy every whole row: first as SQLite finds them, then, where it stumbled, from the pages."""
    stumbled: set[str] = set()
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as old:
            version = old.execute("PRAGMA user_version").fetchone()[0]
            missing = [table for since, tables in ADDED.items() if version < since for table in tables]
            rows = _rows_of_v1(old, report) if version == 1 else _rows_by_tables(old, report, stumbled, missing)
            _write(file, rows)
            if version == 1:
                return
    except sqlite3.DatabaseError as error:
        report.damaged.append(f"the file: {error}")
        stumbled.update(COLUMNS)
    if stumbled:
        found = ((table, values) for table, values in carve(path) if table in stumbled)
        _write(file, found, "DO NOTHING")


def _rows_by_tables(
    old: sqlite3.Connection, report: RepairReport, stumbled: set[str], missing: Collection[str]
) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for table in (name for name in COLUMNS if name not in missing):
        forward, seen = select(table), set()
        backward = forward.replace(f" ORDER BY {', '.join(KEYS[table])}", "") + " ORDER BY rowid DESC"
        for query in (forward, backward):
            try:
                for row in old.execute(query):
                    key = tuple(row[: len(KEYS[table])])
                    if key in seen:
                        continue
                    seen.add(key)
                    if checksum(table, row[:-1]) == row[-1]:
                        yield table, row[:-1]
                    else:
                        stumbled.add(table)
                        report.damaged.append(row_name(table, row))
                break
            except sqlite3.DatabaseError as error:
                stumbled.add(table)
                report.damaged.append(f"table {table}, {len(seen)} rows read: {error}")


def _rows_of_v1(old: sqlite3.Connection, report: RepairReport) -> Iterator[tuple[str, tuple[Any, ...]]]:
    def whole(table: str) -> Iterator[dict[str, Any]]:
        checked = table != "meta"
        query = f"SELECT {', '.join(V1_COLUMNS[table])}{', checksum' * checked} FROM {table}"
        try:
            for row in old.execute(query):
                values = row[:-1] if checked else row
                if checked and checksum_v1(values) != row[-1]:
                    report.damaged.append(f"row {row[0]} of {table}")
                    continue
                yield dict(zip(V1_COLUMNS[table], values, strict=True))
        except sqlite3.DatabaseError as error:
            report.damaged.append(f"table {table}: {error}")

    yield from convert_v1(whole)


def _write(file: MapFile, rows: Iterator[tuple[str, tuple[Any, ...]]], on_conflict: str | None = None) -> None:
    """Write rows in transactions of BATCH."""
    more = True
    while more:
        with file.writing() as database:
            for _ in range(BATCH):
                row = next(rows, None)
                if row is None:
                    more = False
                    break
                table, values = row
                statement = upsert(table)
                if on_conflict is not None:
                    statement = f"{statement.partition(' DO UPDATE')[0]} {on_conflict}"
                database.execute(statement, sealed(table, values))


def _mend(database: sqlite3.Connection, report: RepairReport) -> None:
    """Make all references hold: drop what has lost its parent, and close the gaps in the chains of keyframes."""
    named: set[int] = set()
    for table in OF_KEYFRAME:
        named |= {row[0] for row in database.execute(f"SELECT keyframe_id FROM {table}")}
    keyframes = {row["id"]: row for row in database.execute(select("keyframes"))}
    if lost := sorted(named - set(keyframes)):
        report.lost.append(f"{len(lost)} keyframes: {_listed(lost)}")
    for table in OF_KEYFRAME:
        database.execute(f"DELETE FROM {table} WHERE keyframe_id NOT IN (SELECT id FROM keyframes)")
    for table in ("landmarks", "views", "depths"):
        database.execute(f"DELETE FROM {table} WHERE keyframe_id NOT IN (SELECT keyframe_id FROM features)")
    dangling = "query_id NOT IN (SELECT id FROM keyframes) OR match_id NOT IN (SELECT id FROM keyframes)"
    gone = database.execute(f"SELECT query_id, match_id FROM loops WHERE {dangling}").fetchall()
    if gone:
        report.lost.append(f"{len(gone)} loops: {_listed([f'{row[0]} to {row[1]}' for row in gone])}")
    database.execute(f"DELETE FROM loops WHERE {dangling}")
    for table in ("evidence", "history", "composed", "adjusted_loops"):
        count = database.execute(
            f"DELETE FROM {table} WHERE (query_id, match_id) NOT IN (SELECT query_id, match_id FROM loops)"
        ).rowcount
        if count:
            report.lost.append(f"{count} rows of {table}, of loops that are lost")
    _mend_sessions(database, keyframes, report)
    _mend_cameras(database, keyframes, report)
    _mend_edges(database, keyframes, report)
    database.execute("DELETE FROM spans WHERE keyframe_id NOT IN (SELECT keyframe_id FROM edges)")
    untold = "SELECT keyframe_id FROM features WHERE keyframe_id NOT IN (SELECT keyframe_id FROM views)"
    for (number,) in database.execute(untold).fetchall():  # light is read from the image when it is asked for
        database.execute(upsert("views"), sealed("views", (number, None)))
    for table in ("features", "landmarks", "images"):
        found = {row[0] for row in database.execute(f"SELECT keyframe_id FROM {table}")}
        missing = sorted(set(keyframes) - found)
        if missing and report.damaged:
            report.lost.append(f"{len(missing)} keyframes have no {table} (or were pruned): {_listed(missing)}")
    meta = {row["key"] for row in database.execute(select("meta"))}
    if "mapped" not in meta and keyframes and report.damaged:
        database.execute(upsert("meta"), sealed("meta", ("mapped", str(max(keyframes)))))
        report.mended.append("meta: all keyframes are taken as mapped")


def _mend_sessions(database: sqlite3.Connection, keyframes: dict[int, sqlite3.Row], report: RepairReport) -> None:
    known = {row["id"] for row in database.execute(select("sessions"))}
    for row in keyframes.values():
        if row["session"] not in known:
            known.add(row["session"])
            values = (row["session"], row["id"], row["stamp_ns"], row["session"])
            database.execute(upsert("sessions"), sealed("sessions", values))
            report.mended.append(f"session {row['session']}: made from its keyframes, taken as joined to no other")


def _mend_cameras(database: sqlite3.Connection, keyframes: dict[int, sqlite3.Row], report: RepairReport) -> None:
    known = {row["id"] for row in database.execute(select("cameras"))}
    orphans = [row for row in keyframes.values() if row["camera_id"] is not None and row["camera_id"] not in known]
    for row in orphans:
        values = tuple(None if name == "camera_id" else row[name] for name in COLUMNS["keyframes"])
        database.execute(upsert("keyframes"), sealed("keyframes", values))
    if orphans:
        report.lost.append(f"the calibration of {len(orphans)} keyframes")


def _mend_edges(database: sqlite3.Connection, keyframes: dict[int, sqlite3.Row], report: RepairReport) -> None:
    """Hang keyframes whose predecessor is lost on the one before it: odometry poses are of the whole session."""
    edges = {row["keyframe_id"]: row for row in database.execute(select("edges"))}
    last: dict[int, int] = {}
    bridged = []
    for number, row in keyframes.items():
        before = last.get(row["session"])
        last[row["session"]] = number
        edge = edges.get(number)
        if edge is not None and (edge["previous_id"] is None or edge["previous_id"] in keyframes):
            continue
        try:
            values = _bridge(number, before, row, keyframes, edge)
        except MapCorruptError as error:
            report.lost.append(f"the edge of keyframe {number}: {error}")
            values = (number, None, None, None)
        database.execute(upsert("edges"), sealed("edges", values))
        bridged.append(number)
    if bridged:
        report.mended.append(f"{len(bridged)} keyframes hang on an earlier one of their session: {_listed(bridged)}")


def _bridge(
    number: int,
    before: int | None,
    row: sqlite3.Row,
    keyframes: dict[int, sqlite3.Row],
    edge: sqlite3.Row | None,
) -> tuple[Any, ...]:
    covariance = None if edge is None else decode_array(edge["covariance"])
    T_odom_cam = decode_array(row["T_odom_cam"])
    T_odom_before = None if before is None else decode_array(keyframes[before]["T_odom_cam"])
    if before is None or T_odom_cam is None or T_odom_before is None:
        return (number, before, None, encode_array(covariance))
    if covariance is not None:  # of one motion; the lost ones are taken to be like it
        covariance = covariance * (number - before)
    return (number, before, encode_array(motion_between(T_odom_before, T_odom_cam)), encode_array(covariance))


def _listed(things: list[Any]) -> str:
    return ", ".join(map(str, things[:20])) + (f" and {len(things) - 20} more" if len(things) > 20 else "")
