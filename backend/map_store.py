"""The map on disk: one SQLite file that survives ``kill -9`` at any moment."""

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark.backend.adjustment import Adjustment
from seamark.backend.errors import MapError
from seamark.backend.evidence import encode_evidence
from seamark.backend.map_adjustments import replace_adjustments, write_adjustments
from seamark.backend.map_codec import (
    decode_array,
    encode_array,
    encode_camera,
    encode_keyframe,
    encode_loop,
    lighting_of,
    sealed,
)
from seamark.backend.map_contraction import Contracted, write_means, write_nodes
from seamark.backend.map_file import MapFile
from seamark.backend.map_reader import IMAGES, MapReader, Session
from seamark.backend.map_schema import select, upsert
from seamark.backend.types import Loop, MapSnapshot
from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.types import Keyframe

POSE_TOLERANCE = 1e-9


class MapStore(MapReader):
    """Keyframes, loops and poses in the file ``path``, created when missing (unless ``read_only`` or ``existing``).

    What a method has written is on disk when it returns (write-ahead log, full synchronisation); while the map is
    open, ``path-wal`` and ``path-shm`` belong to it, ``close`` makes it one file again. May be shared by threads.
    What has been pruned of a keyframe is empty when it is read. Raises the errors of
    :class:`~seamark.backend.map_file.MapFile`, and MapCorruptError for damage found by a checksum.
    """

    def __init__(
        self, path: Path, read_only: bool = False, beside_writer: bool = False, existing: bool = False
    ) -> None:
        super().__init__(MapFile(path, read_only, beside_writer, existing))
        self._written: dict[int, tuple[NDArray[np.float64], float]] = {}  # poses as they are in the file

    def __enter__(self) -> "MapStore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def take_over(self) -> None:
        """Become the writer of a map that was opened read-only; raises MapError, and goes on reading, if that fails.

        Other threads that read meanwhile wait.
        """
        with self._opening:
            self.file.close()
            try:
                self.file = MapFile(self.path)
            except MapError:
                self.file = MapFile(self.path, read_only=True)
                raise

    def set_meta(self, values: Mapping[str, str]) -> None:
        """Write facts about the whole map: mode, vocabulary hash, config hash, version that created it, revision."""
        self.record(meta=values)

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Write a keyframe; it is safe on disk when this returns. One that is there already is replaced.

        Raises MapError when its predecessor is not in the map.
        """
        with self.file.writing() as database:
            T_previous_odom = None
            if keyframe.previous_id is not None:
                T_odom_previous = self._odometry_of(database, int(keyframe.previous_id), keyframe)
                T_previous_odom = None if T_odom_previous is None else se3.inverse(T_odom_previous)
            rows = encode_keyframe(keyframe, T_previous_odom)
            session = (int(keyframe.session), int(keyframe.id), int(keyframe.stamp_ns), int(keyframe.session))
            statement = upsert("sessions").partition(" DO UPDATE")[0] + " DO NOTHING"
            database.execute(statement, sealed("sessions", session))
            if keyframe.camera is not None:
                *before, _, T_odom_cam = rows["keyframes"]
                rows["keyframes"] = (*before, self._camera_id(database, keyframe.camera), T_odom_cam)
            for table, values in rows.items():
                database.execute(upsert(table), sealed(table, values))

    def record(
        self,
        loops: Iterable[Loop] = (),
        snapshot: MapSnapshot | None = None,
        meta: Mapping[str, str] | None = None,
        adjustments: Iterable[Adjustment] = (),
    ) -> None:
        """Write in one transaction: loops (replacing earlier verdicts on the same pairs), poses, facts, adjustments
        (replacing what earlier ones found of the same keyframes).
        """
        written: dict[int, tuple[NDArray[np.float64], float]] = {}
        with self.file.writing() as database:
            self._write_loops(database, loops)
            facts = dict(meta or {})
            if snapshot is not None:
                written = self._write_poses(database, snapshot)
                facts["revision"] = str(snapshot.revision)
            database.executemany(upsert("meta"), [sealed("meta", pair) for pair in facts.items()])
            write_adjustments(database, adjustments)
        self._written |= written

    def add_loop(self, loop: Loop) -> None:
        """Write a loop's row, replacing the earlier verdict on the same pair."""
        self.record([loop])

    def add_loops(self, loops: Iterable[Loop]) -> None:
        """Write loops' rows in one transaction, replacing earlier verdicts on the same pairs."""
        self.record(loops)

    def update_poses(self, snapshot: MapSnapshot) -> None:
        """Write all poses and the revision of a snapshot in one transaction."""
        self.record(snapshot=snapshot)

    def update_landmarks(self, landmarks: Mapping[int, NDArray[np.float32]]) -> None:
        """Replace the landmarks (N, 3) of keyframes that have features, in one transaction."""
        rows = [(int(number), encode_array(points)) for number, points in landmarks.items()]
        with self.file.writing() as database:
            database.executemany(upsert("landmarks"), [sealed("landmarks", row) for row in rows])

    def contract(self, change: Contracted) -> None:
        """Forget keyframes and all that belongs to them; what they said lives on in edges and loops, as one change."""
        with self.file.writing() as database:
            write_nodes(database, change)
            self._write_loops(database, change.loops)
            write_means(database, change.means())
            replace_adjustments(database, change.adjustments)
        for number in change.graph.gone:
            self._written.pop(number, None)

    def load_lightings(self, after: int = -1) -> dict[int, NDArray[np.float64]]:
        """Return mean and spread of the colours (6,) of all keyframes ``after`` this one that can be recognised.

        Only those of files of earlier versions are read from the images, once.
        """
        views = self._rows("views", "keyframe_id > ?", (after,))
        found = {row["keyframe_id"]: decode_array(row["lighting"]) for row in views}
        missing = [number for number, lighting in found.items() if lighting is None]
        for number in missing:
            found[number] = lighting_of(self.keyframe(number, (IMAGES,)).thumbnail)
        if missing and not self.file.read_only:
            with self.file.writing() as database:
                rows = [sealed("views", (number, encode_array(found[number]))) for number in missing]
                database.executemany(upsert("views"), rows)
        return {number: lighting for number, lighting in found.items() if lighting is not None}

    def export_single_file(self) -> None:
        """Move the write-ahead log into the file, so that ``path`` alone is the whole map."""
        self.file.checkpoint()

    def copy(self, path: Path) -> None:
        """Write the map as it is at this moment to a new file."""
        with self.file.translated("copied"), closing(sqlite3.connect(path)) as target:
            self.file.database.backup(target)

    def compact(self) -> None:
        """Give the space of what was deleted back to the disk; needs room for a second copy meanwhile."""
        with self.file.translated("written"):
            self.file.database.execute("VACUUM")

    def close(self) -> None:
        """Make the map one file and close it; harmless when repeated."""
        self.file.close()

    def _odometry_of(
        self, database: sqlite3.Connection, previous_id: int, keyframe: Keyframe
    ) -> NDArray[np.float64] | None:
        row = database.execute("SELECT T_odom_cam FROM keyframes WHERE id = ?", (previous_id,)).fetchone()
        if row is None:
            raise MapError(f"keyframe {keyframe.id} follows {previous_id}, which is not in the map")
        return decode_array(row["T_odom_cam"])

    def _camera_id(self, database: sqlite3.Connection, camera: Camera) -> int:
        model = encode_camera(camera)
        row = database.execute("SELECT id FROM cameras WHERE model = ?", (model,)).fetchone()
        if row is not None:
            return int(row["id"])
        number = int(database.execute("SELECT coalesce(max(id) + 1, 0) FROM cameras").fetchone()[0])
        database.execute(upsert("cameras"), sealed("cameras", (number, model)))
        return number

    def _write_loops(self, database: sqlite3.Connection, loops: Iterable[Loop]) -> None:
        for loop in loops:
            key = (int(loop.query_id), int(loop.match_id))
            condition = "SELECT accepted, reason FROM loops WHERE query_id = ? AND match_id = ?"
            before = database.execute(condition, key).fetchone()
            database.execute(upsert("loops"), sealed("loops", encode_loop(loop)))
            if loop.evidence is not None:
                database.execute(upsert("evidence"), sealed("evidence", (*key, encode_evidence(loop.evidence))))
            verdict = (int(loop.accepted), loop.reason.value)
            if before is None or tuple(before) != verdict:
                count, newest, revision = database.execute(
                    "SELECT (SELECT coalesce(max(id), 0) FROM history), (SELECT max(id) FROM keyframes),"
                    " coalesce((SELECT value FROM meta WHERE key = 'revision'), 0)"
                ).fetchone()
                entry = (count + 1, *key, *verdict, newest, int(revision))
                database.execute(upsert("history"), sealed("history", entry))

    def _write_poses(
        self, database: sqlite3.Connection, snapshot: MapSnapshot
    ) -> dict[int, tuple[NDArray[np.float64], float]]:
        """Write the poses that have moved, and the components of their sessions; return what was written."""
        written = {}
        rows = []
        columns = (snapshot.keyframe_ids.tolist(), snapshot.T_map_cam, snapshot.scales.tolist())
        for number, T_map_cam, scale in zip(*columns, strict=True):
            before = self._written.get(number)
            if before is not None and before[1] == scale and not np.abs(before[0] - T_map_cam).max() > POSE_TOLERANCE:
                continue
            written[number] = (T_map_cam, scale)
            pose = encode_array(T_map_cam) if np.isfinite(T_map_cam).all() else None
            rows.append(sealed("poses", (number, pose, float(scale))))
        database.executemany(upsert("poses"), rows)
        wanted = dict(zip(snapshot.sessions.tolist(), snapshot.components.tolist(), strict=True))
        for row in database.execute(select("sessions")).fetchall():
            session = Session(*tuple(row)[:-1])
            if wanted.get(session.id, session.component) != session.component:
                values = (session.id, session.first_keyframe_id, session.stamp_ns, wanted[session.id])
                database.execute(upsert("sessions"), sealed("sessions", values))
        return written
