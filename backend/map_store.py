"""The map on disk: one SQLite file that survives ``kill -9`` at any moment."""

import fcntl
import logging
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import MapError, MapVersionError
from seamark.backend.map_codec import (
    KEYFRAME_COLUMNS,
    LOOP_COLUMNS,
    check_row,
    checksum,
    decode_array,
    decode_keyframe,
    decode_loop,
    encode_array,
    encode_keyframe,
    encode_loop,
)
from seamark.backend.types import Loop, MapSnapshot
from seamark.frontend.types import Keyframe

logger = logging.getLogger(__name__)

APPLICATION_ID = 0x5EA3A12C
SCHEMA_VERSION = 1

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE keyframes (
    id INTEGER PRIMARY KEY, session INTEGER NOT NULL, frame_index INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
    file TEXT NOT NULL, previous_id INTEGER, metric INTEGER NOT NULL, camera TEXT, T_odom_cam BLOB, covariance BLOB,
    points BLOB NOT NULL, scales BLOB NOT NULL, angles BLOB NOT NULL, descriptors BLOB NOT NULL,
    landmarks BLOB NOT NULL, thumbnail BLOB NOT NULL, jpeg BLOB NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE poses (
    keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id), T_map_cam BLOB, component INTEGER NOT NULL,
    scale REAL NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE loops (
    query_id INTEGER NOT NULL, match_id INTEGER NOT NULL, accepted INTEGER NOT NULL, reason TEXT NOT NULL,
    inliers INTEGER NOT NULL, score REAL, votes REAL, jeffrey REAL, T_match_query BLOB, covariance BLOB,
    scale REAL NOT NULL, checksum INTEGER NOT NULL, PRIMARY KEY (query_id, match_id));
"""


class MapStore:
    """Keyframes, loops and poses in the file ``path``, created when missing (unless ``read_only``).

    What a method has written is on disk when it returns (write-ahead log, full synchronisation); while the map is
    open, ``path-wal`` and ``path-shm`` belong to it, ``close`` makes it one file again. May be shared by threads.
    Raises MapVersionError for a file that is no map or of another version, MapCorruptError for damage found by a
    checksum, MapError for anything that the disk refuses.
    """

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._read_only = read_only
        if read_only and not path.exists():
            raise MapError(f"there is no map at {path}")
        with self._translated("opened"):
            mode = "ro" if read_only else "rwc"
            self._database = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={mode}", uri=True, isolation_level=None, check_same_thread=False
            )
            self._database.row_factory = sqlite3.Row
        self._claim: int | None = None
        try:
            with self._translated("opened"):
                self._open()
            if not read_only:
                self._claim = _claim(path)
        except BaseException:
            self._database.close()
            raise

    def __enter__(self) -> "MapStore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def set_meta(self, values: Mapping[str, str]) -> None:
        """Write facts about the whole map: mode, vocabulary hash, config hash, version that created it, revision."""
        with self._translated("written"), self._transaction():
            self._database.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def meta(self) -> dict[str, str]:
        """Return the facts about the whole map."""
        with self._translated("read"):
            return {row["key"]: row["value"] for row in self._database.execute("SELECT * FROM meta ORDER BY key")}

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Write a keyframe; it is safe on disk when this returns. One that is there already is replaced."""
        with self._translated("written"), self._transaction():
            self._database.execute(_insert("keyframes", KEYFRAME_COLUMNS), encode_keyframe(keyframe))

    def add_loop(self, loop: Loop) -> None:
        """Write a loop's row, replacing the earlier verdict on the same pair."""
        self.add_loops([loop])

    def add_loops(self, loops: Iterable[Loop]) -> None:
        """Write loops' rows in one transaction, replacing earlier verdicts on the same pairs."""
        with self._translated("written"), self._transaction():
            self._database.executemany(_insert("loops", LOOP_COLUMNS), map(encode_loop, loops))

    def update_poses(self, snapshot: MapSnapshot) -> None:
        """Write all poses and the revision of a snapshot in one transaction."""
        rows = []
        columns = (snapshot.keyframe_ids, snapshot.T_map_cam, snapshot.components, snapshot.scales)
        for keyframe_id, T_map_cam, component, scale in zip(*columns, strict=True):
            pose = encode_array(T_map_cam) if np.isfinite(T_map_cam).all() else None
            values = (int(keyframe_id), pose, int(component), float(scale))
            rows.append((*values, checksum(values)))
        with self._translated("written"), self._transaction():
            self._database.executemany("INSERT OR REPLACE INTO poses VALUES (?, ?, ?, ?, ?)", rows)
            self._database.execute("INSERT OR REPLACE INTO meta VALUES ('revision', ?)", (str(snapshot.revision),))

    def load_keyframes(self) -> Iterator[Keyframe]:
        """Yield all keyframes by ascending id, read one at a time."""
        with self._translated("read"):
            ids = [row["id"] for row in self._database.execute("SELECT id FROM keyframes ORDER BY id")]
        for keyframe_id in ids:
            yield self.keyframe(keyframe_id)

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """Return one keyframe; raises MapError when there is none of this id."""
        with self._translated("read"):
            columns = ", ".join(KEYFRAME_COLUMNS)
            row = self._database.execute(f"SELECT {columns} FROM keyframes WHERE id = ?", (keyframe_id,)).fetchone()
        if row is None:
            raise MapError(f"{self.path} has no keyframe {keyframe_id}")
        return decode_keyframe(row)

    def load_loops(self) -> tuple[Loop, ...]:
        """Return all loops' rows in the order of their pairs."""
        with self._translated("read"):
            columns = ", ".join(LOOP_COLUMNS)
            rows = self._database.execute(f"SELECT {columns} FROM loops ORDER BY query_id, match_id").fetchall()
        return tuple(decode_loop(row) for row in rows)

    def load_poses(self) -> dict[int, tuple[NDArray[Any] | None, int, float]]:
        """Return for each keyframe that has been in a snapshot its T_map_cam (or None), component and scale."""
        with self._translated("read"):
            rows = self._database.execute("SELECT * FROM poses ORDER BY keyframe_id").fetchall()
        poses = {}
        for row in rows:
            check_row(row, f"pose of keyframe {row['keyframe_id']}")
            poses[row["keyframe_id"]] = (decode_array(row["T_map_cam"]), row["component"], row["scale"])
        return poses

    def export_single_file(self) -> None:
        """Move the write-ahead log into the file, so that ``path`` alone is the whole map."""
        if not self._read_only:
            with self._translated("written"):
                self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def close(self) -> None:
        """Make the map one file and close it; harmless when repeated."""
        try:
            self.export_single_file()
        except MapError as error:
            if not isinstance(error.__cause__, sqlite3.ProgrammingError):  # closed before
                raise
        finally:
            self._database.close()
            if self._claim is not None:  # after the database: closing any descriptor of a file drops SQLite's own locks
                os.close(self._claim)
                self._claim = None

    def _open(self) -> None:
        """Create the tables, or check that they are ours."""
        application_id = self._database.execute("PRAGMA application_id").fetchone()[0]
        version = self._database.execute("PRAGMA user_version").fetchone()[0]
        tables = self._database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if (application_id, version, tables) == (0, 0, 0) and not self._read_only:
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")
            with self._transaction():
                for statement in filter(str.strip, _SCHEMA.split(";")):
                    self._database.execute(statement)
                self._database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                self._database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            _sync_folder(self.path.absolute().parent)
            return
        if application_id != APPLICATION_ID:
            raise MapVersionError(f"{self.path} is no map of Seamark")
        if version != SCHEMA_VERSION:
            raise MapVersionError(f"{self.path} has map version {version}; this program knows {SCHEMA_VERSION}")
        if not self._read_only:
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._database.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._database.execute("COMMIT")
        except BaseException:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
            raise

    @contextmanager
    def _translated(self, verb: str) -> Iterator[None]:
        """Turn SQLite's errors into ours."""
        try:
            with self._lock:
                yield
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB":
                raise MapVersionError(f"{self.path} is no map of Seamark") from error
            raise MapError(f"the map {self.path} cannot be {verb}: {error}") from error


def _insert(table: str, columns: tuple[str, ...]) -> str:
    marks = ", ".join("?" * len(columns))
    return f"INSERT OR REPLACE INTO {table} ({', '.join(columns)}) VALUES ({marks})"


def _claim(path: Path) -> int:
    """Return a descriptor that keeps other writers from the map until it is closed, by whatever end of the process.

    Two services would number their keyframes alike and overwrite one another's.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise MapError(f"the map {path} is in use by another process") from error
    except OSError:  # a file system without locks
        logger.warning("the map %s cannot be locked: keep other services from it", path)
    return descriptor


def _sync_folder(folder: Path) -> None:
    """Make the entry of a new file durable: SQLite does it for its journals only."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
