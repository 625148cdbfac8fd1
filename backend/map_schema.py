"""The tables of a map file, and how files of earlier versions become today's; docs/map.md describes them for users."""

from collections.abc import Iterable
from typing import Final

APPLICATION_ID: Final = 0x5EA3A12C
SCHEMA_VERSION: Final = 5

#: Columns of each table but the last, ``checksum``: the CRC-32 of the table's name and the row's other values. Parents
#: come before what refers to them.
COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "meta": ("key", "value"),
    "sessions": ("id", "first_keyframe_id", "stamp_ns", "component"),
    "cameras": ("id", "model"),
    "keyframes": ("id", "session", "frame_index", "stamp_ns", "file", "metric", "camera_id", "T_odom_cam"),
    "edges": ("keyframe_id", "previous_id", "T_previous_cam", "covariance"),
    "features": ("keyframe_id", "points", "scales", "angles", "descriptors"),
    "landmarks": ("keyframe_id", "points"),
    "images": ("keyframe_id", "jpeg", "thumbnail"),
    "poses": ("keyframe_id", "T_map_cam", "scale"),
    "loops": (
        *("query_id", "match_id", "accepted", "reason", "inliers", "score", "votes", "jeffrey"),
        *("T_match_query", "covariance", "scale"),
    ),
    "evidence": ("query_id", "match_id", "content"),
    "history": ("id", "query_id", "match_id", "accepted", "reason", "newest_keyframe_id", "revision"),
    "views": ("keyframe_id", "lighting"),
    "depths": ("keyframe_id", "inverse"),
    "spans": ("keyframe_id", "steps", "angle", "length", "drift"),
    "composed": ("query_id", "match_id", "count", "scale_sigma"),
    "adjusted": ("keyframe_id", "adjustment", "loops", "previous_id", "T_map_cam", "scale", "covariance"),
    "adjusted_loops": ("query_id", "match_id", "adjustment", "weight"),
}
#: What names a row; all other columns are replaced when it is written again.
KEYS: Final[dict[str, tuple[str, ...]]] = {
    **{table: (columns[0],) for table, columns in COLUMNS.items()},
    "loops": ("query_id", "match_id"),
    "evidence": ("query_id", "match_id"),
    "composed": ("query_id", "match_id"),
    "adjusted_loops": ("query_id", "match_id"),
}

# Rows are small where they are read at start (keyframes, edges, poses) and large where they are read one by one.
TABLES_OF_2: Final = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum INTEGER NOT NULL)",
    """CREATE TABLE sessions (
        id INTEGER PRIMARY KEY, first_keyframe_id INTEGER NOT NULL, stamp_ns INTEGER NOT NULL,
        component INTEGER NOT NULL, checksum INTEGER NOT NULL)""",
    "CREATE TABLE cameras (id INTEGER PRIMARY KEY, model TEXT NOT NULL, checksum INTEGER NOT NULL)",
    """CREATE TABLE keyframes (
        id INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions (id), frame_index INTEGER NOT NULL,
        stamp_ns INTEGER NOT NULL, file TEXT NOT NULL, metric INTEGER NOT NULL,
        camera_id INTEGER REFERENCES cameras (id), T_odom_cam BLOB, checksum INTEGER NOT NULL)""",
    """CREATE TABLE edges (
        keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id) ON DELETE CASCADE,
        previous_id INTEGER REFERENCES keyframes (id), T_previous_cam BLOB, covariance BLOB,
        checksum INTEGER NOT NULL)""",
    """CREATE TABLE features (
        keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id) ON DELETE CASCADE, points BLOB NOT NULL,
        scales BLOB NOT NULL, angles BLOB NOT NULL, descriptors BLOB NOT NULL, checksum INTEGER NOT NULL)""",
    """CREATE TABLE landmarks (
        keyframe_id INTEGER PRIMARY KEY REFERENCES features (keyframe_id) ON DELETE CASCADE, points BLOB NOT NULL,
        checksum INTEGER NOT NULL)""",
    """CREATE TABLE images (
        keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id) ON DELETE CASCADE, jpeg BLOB NOT NULL,
        thumbnail BLOB NOT NULL, checksum INTEGER NOT NULL)""",
    """CREATE TABLE poses (
        keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id) ON DELETE CASCADE, T_map_cam BLOB,
        scale REAL NOT NULL, checksum INTEGER NOT NULL)""",
    """CREATE TABLE loops (
        query_id INTEGER NOT NULL REFERENCES keyframes (id), match_id INTEGER NOT NULL REFERENCES keyframes (id),
        accepted INTEGER NOT NULL, reason TEXT NOT NULL, inliers INTEGER NOT NULL, score REAL, votes REAL,
        jeffrey REAL, T_match_query BLOB, covariance BLOB, scale REAL NOT NULL, checksum INTEGER NOT NULL,
        PRIMARY KEY (query_id, match_id))""",
    """CREATE TABLE evidence (
        query_id INTEGER NOT NULL, match_id INTEGER NOT NULL, content BLOB NOT NULL, checksum INTEGER NOT NULL,
        PRIMARY KEY (query_id, match_id),
        FOREIGN KEY (query_id, match_id) REFERENCES loops (query_id, match_id) ON DELETE CASCADE)""",
    """CREATE TABLE history (
        id INTEGER PRIMARY KEY, query_id INTEGER NOT NULL, match_id INTEGER NOT NULL, accepted INTEGER NOT NULL,
        reason TEXT NOT NULL, newest_keyframe_id INTEGER NOT NULL, revision INTEGER NOT NULL,
        checksum INTEGER NOT NULL,
        FOREIGN KEY (query_id, match_id) REFERENCES loops (query_id, match_id) ON DELETE CASCADE)""",
    # A foreign key without an index makes every deletion read the whole table that it comes from.
    "CREATE INDEX keyframes_of_session ON keyframes (session)",
    "CREATE INDEX edges_from ON edges (previous_id)",
    "CREATE INDEX loops_to ON loops (match_id)",
    "CREATE INDEX history_of_loop ON history (query_id, match_id)",
)
TABLES_OF_3: Final = (
    """CREATE TABLE views (
        keyframe_id INTEGER PRIMARY KEY REFERENCES features (keyframe_id) ON DELETE CASCADE, lighting BLOB,
        checksum INTEGER NOT NULL)""",
    """CREATE TABLE spans (
        keyframe_id INTEGER PRIMARY KEY REFERENCES edges (keyframe_id) ON DELETE CASCADE, steps INTEGER NOT NULL,
        angle REAL NOT NULL, length REAL NOT NULL, drift BLOB NOT NULL, checksum INTEGER NOT NULL)""",
    """CREATE TABLE composed (
        query_id INTEGER NOT NULL, match_id INTEGER NOT NULL, count INTEGER NOT NULL, scale_sigma REAL NOT NULL,
        checksum INTEGER NOT NULL, PRIMARY KEY (query_id, match_id),
        FOREIGN KEY (query_id, match_id) REFERENCES loops (query_id, match_id) ON DELETE CASCADE)""",
)
TABLES_OF_4: Final = (
    """CREATE TABLE depths (
        keyframe_id INTEGER PRIMARY KEY REFERENCES features (keyframe_id) ON DELETE CASCADE, inverse BLOB NOT NULL,
        checksum INTEGER NOT NULL)""",
)
# What a full adjustment found (see adjustment.py): how many loops it rests on stands in every row of it, so that one
# which has lost some is not believed.
TABLES_OF_5: Final = (
    """CREATE TABLE adjusted (
        keyframe_id INTEGER PRIMARY KEY REFERENCES keyframes (id) ON DELETE CASCADE, adjustment INTEGER NOT NULL,
        loops INTEGER NOT NULL, previous_id INTEGER, T_map_cam BLOB NOT NULL, scale REAL NOT NULL, covariance BLOB,
        checksum INTEGER NOT NULL)""",
    """CREATE TABLE adjusted_loops (
        query_id INTEGER NOT NULL, match_id INTEGER NOT NULL, adjustment INTEGER NOT NULL, weight REAL NOT NULL,
        checksum INTEGER NOT NULL, PRIMARY KEY (query_id, match_id),
        FOREIGN KEY (query_id, match_id) REFERENCES loops (query_id, match_id) ON DELETE CASCADE)""",
)
TABLES: Final = TABLES_OF_2 + TABLES_OF_3 + TABLES_OF_4 + TABLES_OF_5


def upsert(table: str) -> str:
    """Return the statement that writes a row: values of the table's COLUMNS, then the checksum."""
    columns, keys = (*COLUMNS[table], "checksum"), KEYS[table]
    updates = ", ".join(f"{name} = excluded.{name}" for name in columns if name not in keys)
    return f"INSERT INTO {table} ({_list(columns)}) VALUES ({_marks(columns)}) ON CONFLICT DO UPDATE SET {updates}"


def select(table: str, condition: str = "") -> str:
    """Return the query for rows of a table, checksum last, in the order of their keys."""
    where = f" WHERE {condition}" if condition else ""
    return f"SELECT {_list((*COLUMNS[table], 'checksum'))} FROM {table}{where} ORDER BY {_list(KEYS[table])}"


def _list(columns: Iterable[str]) -> str:
    return ", ".join(columns)


def _marks(columns: tuple[str, ...]) -> str:
    return ", ".join("?" * len(columns))
