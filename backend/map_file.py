"""The file of a map: opened, locked, of a known version, written in transactions."""

import errno
import logging
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from seamark.backend.errors import MapCorruptError, MapError, MapInUseError, MapUnwritableError, MapVersionError
from seamark.backend.map_lock import MapLock
from seamark.backend.map_migrations import migrate
from seamark.backend.map_schema import APPLICATION_ID, SCHEMA_VERSION, TABLES

logger = logging.getLogger(__name__)

READERS_PATIENCE_S: Final = 1.0  # how long a writer waits for those who read the file as it is
BUSY_TIMEOUT_S: Final = 5.0  # how long SQLite waits for another connection of this process
FULL_BYTES: Final = 1 << 16  # of free space, of which SQLite's shared index alone takes a half
_WAL_LIMIT_BYTES: Final = 64 << 20
_UNWRITABLE: Final = ("SQLITE_FULL", "SQLITE_READONLY", "SQLITE_IOERR", "SQLITE_CANTOPEN")
_UNWRITABLE_ERRNO: Final = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
_CORRUPT: Final = ("SQLITE_CORRUPT", "SQLITE_NOTADB")


class MapFile:
    """A connection to the file ``path``, created when missing (unless ``existing``); to be shared by threads.

    A writer has the file for itself; one of an older version is brought up to date. Readers come in any number, also
    while a writer is at work. While nobody writes, a reader leaves the folder as it was, to the byte. ``database`` is
    used inside of ``reading`` and ``writing`` only. A reader ``beside_writer`` never keeps a writer from coming, and
    leaves SQLite's files in the folder. What is ``read_only`` must be ``existing``.

    Raises MapInUseError for a second writer, MapVersionError for a file that is no map or of another version,
    MapCorruptError for damage, MapUnwritableError for what the disk refuses, MapError for the rest.
    """

    def __init__(
        self, path: Path, read_only: bool = False, beside_writer: bool = False, existing: bool = False
    ) -> None:
        self._beside_writer = beside_writer
        self.path = path
        self.read_only = read_only
        self._lock = threading.RLock()
        if path.is_dir():
            raise MapError(f"{path} is a folder, and a map is a file")
        if (read_only or existing) and not path.exists():
            raise MapError(f"there is no map at {path}")
        if existing and path.stat().st_size == 0:
            raise MapVersionError(f"{path} is no map of Seamark")
        self._claim: MapLock | None = None
        with self.translated("opened"):
            self._claim = self._claimed()
            try:
                self.database = self._connect()
                self._open()
            except BaseException:
                self.close()
                raise

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Give the connection to one thread; errors become ours."""
        with self.translated("read"):
            yield self.database

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """Give the connection inside a transaction: what was done is on disk when the block ends, or undone."""
        with self.translated("written"):
            self.database.execute("BEGIN IMMEDIATE")
            try:
                yield self.database
                self.database.execute("COMMIT")
            except BaseException:
                if self.database.in_transaction:
                    self.database.execute("ROLLBACK")
                raise

    @contextmanager
    def translated(self, verb: str) -> Iterator[None]:
        """Turn SQLite's errors into ours."""
        try:
            with self._lock:
                yield
        except sqlite3.Error as error:
            name, kind, why = getattr(error, "sqlite_errorname", ""), MapError, str(error)
            if name == "SQLITE_NOTADB":
                raise MapVersionError(f"{self.path} is no map of Seamark") from error
            if name.startswith(_UNWRITABLE):
                kind = MapUnwritableError
                if _is_full(self.path.absolute().parent):
                    why = "no space left on the disk"
            elif name.startswith(_CORRUPT):
                kind = MapCorruptError
            raise kind(f"the map {self.path} cannot be {verb}: {why}") from error
        except OSError as error:
            kind = MapUnwritableError if error.errno in _UNWRITABLE_ERRNO else MapError
            raise kind(f"the map {self.path} cannot be {verb}: {error}") from error

    def checkpoint(self) -> None:
        """Move the write-ahead log into the file, so that ``path`` alone is the whole map."""
        if not self.read_only:
            with self.translated("written"):
                self.database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def close(self) -> None:
        """Make the map one file and close it; harmless when repeated."""
        try:
            if hasattr(self, "database"):
                self.checkpoint()
        except MapUnwritableError as error:  # the log keeps what the file has no room for
            logger.warning("%s; %s-wal belongs to it", error, self.path.name)
        except MapError as error:
            if not isinstance(error.__cause__, sqlite3.ProgrammingError):  # closed before
                raise
        finally:
            if hasattr(self, "database"):
                self.database.close()
            if self._claim is not None:
                self._claim.close()

    def _claimed(self) -> MapLock | None:
        """Lock the file, which is made if it is missing."""
        if self.read_only and self._beside_writer:
            return None
        if self.read_only:
            return MapLock(self.path, exclusive=False)
        if not self.path.exists():
            self.path.touch()
        deadline = time.monotonic() + READERS_PATIENCE_S
        while True:
            try:
                return MapLock(self.path, exclusive=True)
            except MapInUseError as error:
                if not error.by_readers or time.monotonic() > deadline:
                    raise
            time.sleep(0.05)

    def _connect(self) -> sqlite3.Connection:
        mode = "mode=ro" if self.read_only else "mode=rw"
        log = self.path.with_name(self.path.name + "-wal")
        if self.read_only and self._claim is not None and self._claim.undisturbed and not _has_content(log):
            mode += "&immutable=1"
        database = sqlite3.connect(
            f"{self.path.absolute().as_uri()}?{mode}",
            uri=True,
            timeout=BUSY_TIMEOUT_S,
            isolation_level=None,
            check_same_thread=False,
        )
        database.row_factory = sqlite3.Row
        return database

    def _open(self) -> None:
        """Create the tables, or check that they are ours."""
        database = self.database
        application_id = database.execute("PRAGMA application_id").fetchone()[0]
        version = database.execute("PRAGMA user_version").fetchone()[0]
        tables = database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        new = (application_id, version, tables) == (0, 0, 0)
        if application_id != APPLICATION_ID and (self.read_only or not new):
            raise MapVersionError(f"{self.path} is no map of Seamark")
        if not new and not 1 <= version <= SCHEMA_VERSION:
            raise MapVersionError(f"{self.path} has map version {version}; this program knows {SCHEMA_VERSION}")
        if self.read_only:
            if version != SCHEMA_VERSION:
                raise MapVersionError(
                    f"{self.path} has map version {version}; a service that learns brings it to {SCHEMA_VERSION},"
                    " and so does seamark map repair"
                )
            return
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = FULL")
        # Some builds of SQLite overwrite what is deleted with zeros: forgetting a keyframe would cost as much writing
        # as learning it, and could not be done on a full disk.
        database.execute("PRAGMA secure_delete = FAST")
        database.execute(f"PRAGMA journal_size_limit = {_WAL_LIMIT_BYTES}")
        database.execute("PRAGMA foreign_keys = ON")
        if new or version < SCHEMA_VERSION:
            with self.writing():
                if new:
                    for statement in TABLES:
                        database.execute(statement)
                    database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                else:
                    logger.warning("%s is brought from map version %d to %d", self.path, version, SCHEMA_VERSION)
                    migrate(database, version)
                database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        if new:
            sync_to_disk(self.path.absolute().parent)


def _is_full(folder: Path) -> bool:
    """Return whether there is no room for a page: SQLite calls that an I/O error here and there."""
    try:
        return shutil.disk_usage(folder).free < FULL_BYTES
    except OSError:
        return False


def _has_content(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0


def sync_to_disk(path: Path) -> None:
    """Make a file durable, or the entries of a folder: of a new file SQLite sees to those of its journals only."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
