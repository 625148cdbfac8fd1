"""What full adjustments have found, to and from a map on disk."""

import sqlite3
from collections.abc import Iterable, Sequence

import numpy as np

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.errors import MapCorruptError
from seamark.backend.map_codec import Row, decode_array, encode_array, sealed
from seamark.backend.map_schema import upsert


def write_adjustments(database: sqlite3.Connection, adjustments: Iterable[Adjustment]) -> None:
    """Write what adjustments found in place of what earlier ones had of the same keyframes and loops.

    Inside the caller's transaction. An earlier one that loses a keyframe so goes as a whole.
    """
    for one in adjustments:
        ids = [(int(number),) for number in one.poses]
        query = "SELECT adjustment FROM adjusted WHERE keyframe_id = ?"
        earlier = {row[0] for number in ids for row in database.execute(query, number)} | {one.id}
        for table in ("adjusted", "adjusted_loops"):
            database.executemany(f"DELETE FROM {table} WHERE adjustment = ?", [(number,) for number in earlier])
        rows = [sealed("adjusted", _encode(one, number, pose)) for number, pose in one.poses.items()]
        database.executemany(upsert("adjusted"), rows)
        loops = [sealed("adjusted_loops", (*map(int, key), int(one.id), float(w))) for key, w in one.loops.items()]
        database.executemany(upsert("adjusted_loops"), loops)


def replace_adjustments(database: sqlite3.Connection, adjustments: Iterable[Adjustment]) -> None:
    """Write these in place of all that there were, inside the caller's transaction."""
    for table in ("adjusted", "adjusted_loops"):
        database.execute(f"DELETE FROM {table}")
    write_adjustments(database, adjustments)


def decode_adjustments(poses: Sequence[Row], loops: Sequence[Row]) -> tuple[Adjustment, ...]:
    """Return the adjustments of the rows of both tables.

    One that lacks loops which it rests on is left out: nobody could tell whether it stands.
    """
    found: dict[int, dict[int, AdjustedPose]] = {}
    rests: dict[int, dict[tuple[int, int], float]] = {}
    wanted = {}
    for row in poses:
        found.setdefault(row["adjustment"], {})[row["keyframe_id"]] = decode_adjusted(row)
        wanted[row["adjustment"]] = row["loops"]
    for row in loops:
        rests.setdefault(row["adjustment"], {})[row["query_id"], row["match_id"]] = row["weight"]
    whole = (number for number in sorted(found) if len(rests.get(number, {})) == wanted[number])
    return tuple(Adjustment(number, found[number], rests.get(number, {})) for number in whole)


def decode_adjusted(row: Row) -> AdjustedPose:
    """Return a keyframe's row; raises MapCorruptError for one without a pose."""
    T, covariance = decode_array(row["T_map_cam"]), decode_array(row["covariance"])
    if T is None or T.shape != (4, 4) or not np.isfinite(T).all() or not row["scale"] > 0:
        raise MapCorruptError(f"the adjusted pose of keyframe {row['keyframe_id']} is none")
    if covariance is not None and covariance.shape != (6, 6):
        raise MapCorruptError(f"the adjusted motion of keyframe {row['keyframe_id']} has a covariance that is none")
    return AdjustedPose(T, row["scale"], row["previous_id"], covariance)


def _encode(one: Adjustment, number: int, pose: AdjustedPose) -> tuple[object, ...]:
    previous_id = None if pose.previous_id is None else int(pose.previous_id)
    arrays = (encode_array(pose.T_map_cam), float(pose.scale), encode_array(pose.covariance))
    return (int(number), int(one.id), len(one.loops), previous_id, *arrays)
