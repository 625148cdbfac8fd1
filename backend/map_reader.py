"""What a map file holds, read: keyframes, loops with their evidence and history, sessions, poses."""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from seamark.backend.adjustment import Adjustment
from seamark.backend.errors import MapCorruptError, MapError
from seamark.backend.evidence import Evidence, decode_evidence
from seamark.backend.graph_types import Span
from seamark.backend.map_adjustments import decode_adjustments
from seamark.backend.map_codec import (
    check_row,
    decode_array,
    decode_camera,
    decode_keyframe,
    decode_loop,
    decode_span,
)
from seamark.backend.map_contraction import Mean
from seamark.backend.map_file import MapFile
from seamark.backend.map_schema import select
from seamark.backend.types import Loop, Reason
from seamark.frontend.camera import Camera
from seamark.frontend.types import Keyframe

FEATURES, IMAGES = "features", "images"


@dataclass(frozen=True)
class Verdict:
    """One entry of a loop's history: what was thought of it when keyframe ``newest_keyframe_id`` was the newest."""

    accepted: bool
    reason: Reason
    newest_keyframe_id: int
    revision: int


@dataclass(frozen=True)
class Session:
    """One session: where it begins, and the session in whose frame of reference its poses are."""

    id: int
    first_keyframe_id: int
    stamp_ns: int
    component: int


class MapReader:
    """Reads the rows of an open map file, each of which its checksum must bear out.

    What has been pruned of a keyframe is empty. Raises MapError, and MapCorruptError for damage found by a checksum.
    May be shared by threads.
    """

    def __init__(self, file: MapFile) -> None:
        self.path = file.path
        self.file = file
        self._opening = threading.RLock()  # held while the file is read, and while it is opened anew
        self._cameras: dict[int, Camera] = {}

    def meta(self) -> dict[str, str]:
        """Return the facts about the whole map."""
        return {row["key"]: row["value"] for row in self._rows("meta")}

    def evidence(self, query_id: int, match_id: int) -> Evidence | None:
        """Return what a loop rests on, None when nothing was kept."""
        rows = self._rows("evidence", "query_id = ? AND match_id = ?", (int(query_id), int(match_id)))
        return decode_evidence(rows[0]["content"]) if rows else None

    def history(self, query_id: int, match_id: int) -> tuple[Verdict, ...]:
        """Return all verdicts on a loop, the oldest first."""
        rows = self._rows("history", "query_id = ? AND match_id = ?", (int(query_id), int(match_id)))
        return tuple(
            Verdict(bool(row["accepted"]), Reason(row["reason"]), row["newest_keyframe_id"], row["revision"])
            for row in rows
        )

    def keyframe_ids(self, recognisable: bool = False) -> list[int]:
        """Return the ids of all keyframes, or of those that have features, ascending."""
        table, column = ("views", "keyframe_id") if recognisable else ("keyframes", "id")
        with self._reading() as database:
            return [row[0] for row in database.execute(f"SELECT {column} FROM {table} ORDER BY 1")]

    def load_keyframes(self) -> Iterator[Keyframe]:
        """Yield all keyframes by ascending id, read one at a time."""
        for keyframe_id in self.keyframe_ids():
            yield self.keyframe(keyframe_id)

    def load_nodes(self) -> list[Keyframe]:
        """Return all keyframes by ascending id without features, landmarks and images."""
        keyframes, edges = self._rows("keyframes"), {row["keyframe_id"]: row for row in self._rows("edges")}
        return [
            decode_keyframe(row, _edge(edges.get(row["id"]), row["id"]), self._camera(row["camera_id"]))
            for row in keyframes
        ]

    def keyframe(self, keyframe_id: int, parts: tuple[str, ...] = (FEATURES, IMAGES)) -> Keyframe:
        """Return one keyframe with these parts of it; raises MapError when there is none of this id."""
        number = (int(keyframe_id),)
        rows = self._rows("keyframes", "id = ?", number)
        if not rows:
            raise MapError(f"{self.path} has no keyframe {keyframe_id}")
        tables = (
            ("edges",) + ("features", "landmarks", "depths") * (FEATURES in parts) + ("images",) * (IMAGES in parts)
        )
        found = {table: next(iter(self._rows(table, "keyframe_id = ?", number)), None) for table in tables}
        edge, camera = _edge(found.pop("edges"), keyframe_id), self._camera(rows[0]["camera_id"])
        return decode_keyframe(rows[0], edge, camera, **found)

    def load_loops(self) -> tuple[Loop, ...]:
        """Return all loops' rows in the order of their pairs."""
        return tuple(decode_loop(row) for row in self._rows("loops"))

    def load_sessions(self) -> tuple[Session, ...]:
        """Return all sessions by ascending id."""
        return tuple(Session(*tuple(row)[:-1]) for row in self._rows("sessions"))

    def load_poses(self) -> dict[int, tuple[NDArray[Any] | None, int, float]]:
        """Return for each keyframe that has been in a snapshot its T_map_cam (or None), component and scale."""
        components = {session.id: session.component for session in self.load_sessions()}
        sessions = self.session_of_keyframes()
        return {
            row["keyframe_id"]: (
                decode_array(row["T_map_cam"]),
                components.get(sessions[row["keyframe_id"]], sessions[row["keyframe_id"]]),
                row["scale"],
            )
            for row in self._rows("poses")
        }

    def load_spans(self) -> dict[int, Span]:
        """Return what the motions are made of on whose way keyframes have gone."""
        return {row["keyframe_id"]: decode_span(row) for row in self._rows("spans")}

    def load_means(self) -> dict[tuple[int, int], Mean]:
        """Return what is known of composed loops beside their rows."""
        return {
            (row["query_id"], row["match_id"]): Mean(row["count"], row["scale_sigma"]) for row in self._rows("composed")
        }

    def load_adjustments(self) -> tuple[Adjustment, ...]:
        """Return what full adjustments have found, whether they stand or not."""
        return decode_adjustments(self._rows("adjusted"), self._rows("adjusted_loops"))

    def session_of_keyframes(self) -> dict[int, int]:
        """Return the session of each keyframe."""
        with self._reading() as database:
            return dict(map(tuple, database.execute("SELECT id, session FROM keyframes")))

    def bytes_used(self) -> int:
        """Return how many bytes of the file hold something: free pages are used again before it grows."""
        with self._reading() as database:
            names = ("page_count", "freelist_count", "page_size")
            count, free, size = (database.execute(f"PRAGMA {name}").fetchone()[0] for name in names)
        return int((count - free) * size)

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._opening, self.file.reading() as database:
            yield database

    def _rows(self, table: str, condition: str = "", values: tuple[Any, ...] = ()) -> list[sqlite3.Row]:
        with self._reading() as database:
            rows = database.execute(select(table, condition), values).fetchall()
        for row in rows:
            check_row(table, row)
        return rows

    def _camera(self, camera_id: int | None) -> Camera | None:
        if camera_id is not None and camera_id not in self._cameras:
            self._cameras |= {row["id"]: decode_camera(row["model"]) for row in self._rows("cameras")}
        return None if camera_id is None else self._cameras[camera_id]


def _edge(row: sqlite3.Row | None, keyframe_id: int) -> sqlite3.Row:
    if row is None:
        raise MapCorruptError(f"the edge of keyframe {keyframe_id} is missing")
    return row
