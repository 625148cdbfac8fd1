"""What is in a map, in numbers."""

from dataclasses import dataclass
from pathlib import Path

from seamark.backend.map_schema import COLUMNS, SCHEMA_VERSION
from seamark.backend.map_store import MapStore

BLOBS = {
    "descriptors": "SELECT sum(length(descriptors)) FROM features",
    "key_points": "SELECT sum(length(points) + length(scales) + length(angles)) FROM features",
    "landmarks": "SELECT sum(length(points)) FROM landmarks",
    "depths": "SELECT sum(length(inverse)) FROM depths",
    "images": "SELECT sum(length(jpeg)) FROM images",
    "thumbnails": "SELECT sum(length(thumbnail)) FROM images",
}


@dataclass(frozen=True)
class MapInfo:
    """``rows`` per table, ``bytes_of`` the large columns, ``sessions`` with their keyframes and component.

    ``recognisable`` keyframes have features; the others were pruned. ``accepted_loops`` stand now, ``withdrawn`` ones
    stood once. ``adjusted`` keyframes are where a full adjustment that stands has put them.
    """

    version: int
    file_bytes: int
    used_bytes: int
    meta: dict[str, str]
    rows: dict[str, int]
    bytes_of: dict[str, int]
    recognisable: int
    accepted_loops: int
    withdrawn_loops: int
    reasons: dict[str, int]
    sessions: tuple[dict[str, int], ...]
    adjusted: int


def describe_map(path: Path) -> MapInfo:
    """Return what is in a map; raises MapError."""
    with MapStore(path, read_only=True) as store:
        meta, sessions = store.meta(), store.load_sessions()
        of_session = list(store.session_of_keyframes().values())
        accepted = {(loop.query_id, loop.match_id) for loop in store.load_loops() if loop.accepted}
        standing = [one for one in store.load_adjustments() if one.stands(accepted)]
        with store.file.reading() as database:

            def one(query: str) -> int:
                return int(database.execute(query).fetchone()[0] or 0)

            withdrawn = (
                "SELECT count(*) FROM loops WHERE NOT accepted AND EXISTS (SELECT 1 FROM history WHERE"
                " history.query_id = loops.query_id AND history.match_id = loops.match_id AND history.accepted)"
            )
            reasons = database.execute("SELECT reason, count(*) FROM loops GROUP BY reason ORDER BY reason")
            return MapInfo(
                version=SCHEMA_VERSION,
                file_bytes=_size(path),
                used_bytes=store.bytes_used(),
                meta=meta,
                rows={table: one(f"SELECT count(*) FROM {table}") for table in COLUMNS},
                bytes_of={name: one(query) for name, query in BLOBS.items()},
                recognisable=one("SELECT count(*) FROM features"),
                accepted_loops=one("SELECT count(*) FROM loops WHERE accepted"),
                withdrawn_loops=one(withdrawn),
                reasons=dict(map(tuple, reasons.fetchall())),
                sessions=tuple(
                    {
                        "id": session.id,
                        "component": session.component,
                        "first_keyframe": session.first_keyframe_id,
                        "keyframes": of_session.count(session.id),
                        "stamp_ns": session.stamp_ns,
                    }
                    for session in sessions
                ),
                adjusted=sum(len(one.poses) for one in standing),
            )


def _size(path: Path) -> int:
    """Return the size of the file and its log."""
    log = path.with_name(path.name + "-wal")
    return path.stat().st_size + (log.stat().st_size if log.exists() else 0)
