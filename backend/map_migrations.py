"""Map files of earlier versions become today's, in one transaction."""

import logging
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import MapCorruptError
from seamark.backend.map_codec import decode_array, encode_array, motion_between, sealed
from seamark.backend.map_schema import TABLES_OF_2, TABLES_OF_3, TABLES_OF_4, TABLES_OF_5, upsert

logger = logging.getLogger(__name__)

Rows = Iterator[tuple[str, tuple[Any, ...]]]

V1_COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "meta": ("key", "value"),
    "keyframes": (
        *("id", "session", "frame_index", "stamp_ns", "file", "previous_id", "metric", "camera", "T_odom_cam"),
        *("covariance", "points", "scales", "angles", "descriptors", "landmarks", "thumbnail", "jpeg"),
    ),
    "poses": ("keyframe_id", "T_map_cam", "component", "scale"),
    "loops": (
        *("query_id", "match_id", "accepted", "reason", "inliers", "score", "votes", "jeffrey"),
        *("T_match_query", "covariance", "scale"),
    ),
}


def migrate(database: sqlite3.Connection, version: int) -> None:
    """Bring the tables of an older version up to date, inside the caller's transaction.

    Raises MapCorruptError when a row of the old tables is damaged: ``seamark map repair`` goes on without it.
    """
    for step in range(version, len(MIGRATIONS) + 1):
        MIGRATIONS[step - 1](database)


def _from_1_to_2(database: sqlite3.Connection) -> None:
    """Split the wide table of keyframes, and give sessions, cameras and the history of loops tables of their own."""
    for table in V1_COLUMNS:
        database.execute(f"ALTER TABLE {table} RENAME TO old_{table}")
    for statement in TABLES_OF_2:
        database.execute(statement)

    def old(table: str) -> Iterator[dict[str, Any]]:
        columns = V1_COLUMNS[table]
        query = f"SELECT {', '.join(columns)} FROM old_{table}"
        if table == "meta":  # the one table without checksums, and without row numbers
            yield from (dict(zip(columns, row, strict=True)) for row in database.execute(query).fetchall())
            return
        query = query.replace(" FROM", ", checksum FROM") + " WHERE rowid = ?"
        for (number,) in database.execute(f"SELECT rowid FROM old_{table} ORDER BY 1").fetchall():
            *values, expected = database.execute(query, (number,)).fetchone()
            if checksum_v1(values) != expected:
                raise MapCorruptError(f"row {values[0]} of {table} is damaged: its checksum differs")
            yield dict(zip(columns, values, strict=True))

    for table, values in convert_v1(old):
        database.execute(upsert(table), sealed(table, values))
    for table in reversed(V1_COLUMNS):
        database.execute(f"DROP TABLE old_{table}")


def convert_v1(old: Callable[[str], Iterable[dict[str, Any]]]) -> Rows:
    """Yield rows of version 2 (table, values), parents first, of the rows of a file of version 1 that ``old`` gives."""
    components = {row["keyframe_id"]: row["component"] for row in old("poses")}
    revision = 0
    for row in old("meta"):
        revision = int(row["value"]) if row["key"] == "revision" else revision
        yield "meta", (row["key"], row["value"])
    cameras: dict[str, int] = {}
    sessions: set[int] = set()
    poses: dict[int, NDArray[np.float64] | None] = {}
    for row in old("keyframes"):
        number, session, camera = row["id"], row["session"], row["camera"]
        if session not in sessions:
            sessions.add(session)
            yield "sessions", (session, number, row["stamp_ns"], components.get(number, session))
        if camera is not None and camera not in cameras:
            cameras[camera] = len(cameras)
            yield "cameras", (cameras[camera], camera)
        T_odom_cam = decode_array(row["T_odom_cam"])
        previous_id = row["previous_id"] if row["previous_id"] in poses else None
        before = poses.get(previous_id) if previous_id is not None else None
        motion = None if before is None or T_odom_cam is None else encode_array(motion_between(before, T_odom_cam))
        poses[number] = T_odom_cam
        yield (
            "keyframes",
            (
                *(number, session, row["frame_index"], row["stamp_ns"], row["file"], row["metric"]),
                *(None if camera is None else cameras[camera], row["T_odom_cam"]),
            ),
        )
        yield "edges", (number, previous_id, motion, row["covariance"])
        yield "features", (number, row["points"], row["scales"], row["angles"], row["descriptors"])
        yield "landmarks", (number, row["landmarks"])
        yield "images", (number, row["jpeg"], row["thumbnail"])
    for row in old("poses"):
        if row["keyframe_id"] in poses:
            yield "poses", (row["keyframe_id"], row["T_map_cam"], row["scale"])
    newest = max(poses, default=0)
    count = 0
    for row in old("loops"):
        if row["query_id"] not in poses or row["match_id"] not in poses:
            logger.warning("loop %s to %s names a keyframe that is not there", row["query_id"], row["match_id"])
            continue
        count += 1
        yield "loops", tuple(row.values())
        yield "history", (count, row["query_id"], row["match_id"], row["accepted"], row["reason"], newest, revision)


def checksum_v1(values: Sequence[Any]) -> int:
    """Return the checksum of a row of version 1: that of today without the table's name."""
    crc = 0
    for value in values:
        data = value if isinstance(value, bytes) else repr(value).encode()
        crc = zlib.crc32(f"{type(value).__name__} {len(data)}\n".encode() + data, crc)
    return crc


def _from_2_to_3(database: sqlite3.Connection) -> None:
    """Add tables for what is composed of forgotten keyframes, and one of the views that there are."""
    for statement in TABLES_OF_3:
        database.execute(statement)
    ids = database.execute("SELECT keyframe_id FROM features ORDER BY 1").fetchall()
    database.executemany(upsert("views"), [sealed("views", (number, None)) for (number,) in ids])


def _from_3_to_4(database: sqlite3.Connection) -> None:
    """Add a table for depth images; keyframes of before have none."""
    for statement in TABLES_OF_4:
        database.execute(statement)


def _from_4_to_5(database: sqlite3.Connection) -> None:
    """Add tables for what full adjustments find."""
    for statement in TABLES_OF_5:
        database.execute(statement)


MIGRATIONS: Final = (_from_1_to_2, _from_2_to_3, _from_3_to_4, _from_4_to_5)
