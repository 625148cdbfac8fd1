"""Keyframes and loops to and from the rows of a map on disk; see map_schema.py for the columns."""

import json
import sqlite3
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import MapCorruptError
from seamark.backend.graph_types import Span
from seamark.backend.types import Loop, Reason
from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.types import Features, Keyframe

Values = tuple[Any, ...]
Row = Mapping[str, Any] | sqlite3.Row

_DTYPES: Final = {"f4": np.float32, "f8": np.float64, "u1": np.uint8}
NO_THUMBNAIL: Final = np.zeros((0, 0), np.uint8)
NO_LANDMARKS: Final = np.zeros((0, 3), np.float32)


_LOOP_TABLES: Final = {
    "loops": "loop",
    "evidence": "the evidence of loop",
    "composed": "what is composed to loop",
    "adjusted_loops": "what an adjustment made of loop",
}


def encode_array(array: NDArray[Any] | None) -> bytes | None:
    """Return dtype and shape as one line of text, then the numbers in C order, little endian."""
    if array is None:
        return None
    code = array.dtype.newbyteorder("<").str[1:]
    if code not in _DTYPES:
        raise TypeError(f"arrays of {array.dtype} are not stored in maps")
    header = f"{code} {' '.join(map(str, array.shape))}\n".encode()
    return header + np.ascontiguousarray(array, _DTYPES[code]).tobytes()


def decode_array(blob: bytes | None) -> NDArray[Any] | None:
    """Return the read-only array of :func:`encode_array`; raises MapCorruptError for anything else."""
    if blob is None:
        return None
    try:
        header, _, data = blob.partition(b"\n")
        code, *shape = header.decode().split()
        return np.frombuffer(data, _DTYPES[code]).reshape([int(n) for n in shape])
    except (ValueError, KeyError, AttributeError) as error:
        raise MapCorruptError(f"the map holds an array that is none: {error}") from error


def encode_keyframe(keyframe: Keyframe, T_previous_odom: NDArray[np.float64] | None) -> dict[str, Values]:
    """Return the rows of a keyframe in the tables that have some; its camera_id is left None.

    ``T_previous_odom`` (4, 4) is the inverse of the previous keyframe's odometry pose.
    """
    features, number = keyframe.features, int(keyframe.id)
    T_previous_cam = None
    if T_previous_odom is not None and keyframe.T_odom_cam is not None:
        T_previous_cam = T_previous_odom @ keyframe.T_odom_cam
    previous_id = None if keyframe.previous_id is None else int(keyframe.previous_id)
    rows: dict[str, Values] = {
        "keyframes": (
            *(number, int(keyframe.session), int(keyframe.index), int(keyframe.stamp_ns), keyframe.file),
            *(int(keyframe.metric), None, encode_array(keyframe.T_odom_cam)),
        ),
        "edges": (number, previous_id, encode_array(T_previous_cam), encode_array(keyframe.covariance)),
        "features": (
            *(number, encode_array(features.points), encode_array(features.scales)),
            *(encode_array(features.angles), encode_array(features.descriptors)),
        ),
        "landmarks": (number, encode_array(keyframe.landmarks)),
        "images": (number, keyframe.jpeg, encode_array(keyframe.thumbnail)),
        "views": (number, encode_array(lighting_of(keyframe.thumbnail))),
    }
    return rows | ({"depths": (number, keyframe.depth)} if keyframe.depth else {})


def lighting_of(thumbnail: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return mean and standard deviation (6,) of the three colours of a thumbnail, in 0..1."""
    if thumbnail.size == 0:
        return np.zeros(6)
    colours = thumbnail.reshape(-1, thumbnail.shape[2] if thumbnail.ndim == 3 else 1)[:, :3] / 255.0
    colours = np.broadcast_to(colours, (len(colours), 3))
    return np.concatenate([colours.mean(axis=0), colours.std(axis=0)])


def encode_camera(camera: Camera) -> str:
    """Return the camera as JSON."""
    return json.dumps(asdict(camera))


def decode_camera(text: str) -> Camera:
    """Return the camera of :func:`encode_camera`."""
    stored = json.loads(text)
    return Camera(**{**stored, "distortion": tuple(stored["distortion"])})


def decode_keyframe(
    keyframe: Row,
    edge: Row,
    camera: Camera | None,
    features: Row | None = None,
    landmarks: Row | None = None,
    images: Row | None = None,
    depths: Row | None = None,
) -> Keyframe:
    """Return the keyframe of its rows; what is None (not asked for, or pruned) is empty."""
    return Keyframe(
        id=keyframe["id"],
        session=keyframe["session"],
        index=keyframe["frame_index"],
        stamp_ns=keyframe["stamp_ns"],
        file=keyframe["file"],
        features=Features.empty() if features is None else decode_features(features),
        landmarks=NO_LANDMARKS if landmarks is None else decode_array(landmarks["points"]),  # type: ignore[arg-type]
        thumbnail=NO_THUMBNAIL if images is None else decode_array(images["thumbnail"]),  # type: ignore[arg-type]
        jpeg=b"" if images is None else images["jpeg"],
        camera=camera,
        previous_id=edge["previous_id"],
        T_odom_cam=decode_array(keyframe["T_odom_cam"]),
        covariance=decode_array(edge["covariance"]),
        metric=bool(keyframe["metric"]),
        depth=b"" if depths is None else depths["inverse"],
    )


def decode_features(row: Row) -> Features:
    """Return the features of a row of their table."""
    arrays = [decode_array(row[name]) for name in ("points", "scales", "angles", "descriptors")]
    return Features(*arrays)  # type: ignore[arg-type]


def encode_loop(loop: Loop) -> Values:
    """Return the row of a loop."""
    return (
        *(int(loop.query_id), int(loop.match_id), int(loop.accepted), loop.reason.value, int(loop.inliers)),
        *(float(loop.score), float(loop.votes), float(loop.jeffrey)),
        *(encode_array(loop.T_match_query), encode_array(loop.covariance), float(loop.scale)),
    )


def decode_loop(row: Row) -> Loop:
    """Return the loop of a row."""
    return Loop(
        query_id=row["query_id"],
        match_id=row["match_id"],
        accepted=bool(row["accepted"]),
        reason=Reason(row["reason"]),
        inliers=row["inliers"],
        score=_number(row["score"]),
        votes=_number(row["votes"]),
        jeffrey=_number(row["jeffrey"]),
        T_match_query=decode_array(row["T_match_query"]),
        covariance=decode_array(row["covariance"]),
        scale=row["scale"],
    )


def checksum(table: str, values: Sequence[Any]) -> int:
    """Return the CRC-32 of a table's name and a row's values; names and lengths keep them apart.

    The name is in it so that a row can be told without the tables around it, when a damaged file is searched for rows.
    """
    crc = zlib.crc32(table.encode())
    for value in values:
        if isinstance(value, float) and value != value:
            value = None  # SQLite stores a NaN as NULL
        data = value if isinstance(value, bytes) else repr(value).encode()
        crc = zlib.crc32(data, zlib.crc32(f"{type(value).__name__} {len(data)}\n".encode(), crc))
    return crc


def sealed(table: str, values: Values) -> Values:
    """Return a row as it is written: its values and their checksum."""
    return (*values, checksum(table, values))


def check_row(table: str, row: Sequence[Any] | sqlite3.Row) -> None:
    """Raise MapCorruptError unless the last column is the checksum of the others."""
    *values, expected = tuple(row)
    if checksum(table, values) != expected:
        raise MapCorruptError(f"{row_name(table, values)} of the map is damaged: its checksum differs")


def row_name(table: str, values: Sequence[Any]) -> str:
    """Return what a row is called in messages."""
    if table in _LOOP_TABLES:
        what = _LOOP_TABLES[table]
        return f"{what} {values[0]} to {values[1]}"
    if table == "keyframes":
        return f"keyframe {values[0]}"
    if table in ("edges", "features", "landmarks", "images", "poses", "views", "depths", "spans", "adjusted"):
        return f"row {table} of keyframe {values[0]}"
    return f"row {values[0]} of {table}"


def motion_between(T_odom_previous: NDArray[np.float64], T_odom_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``T_previous_cam`` of two odometry poses."""
    return se3.inverse(T_odom_previous) @ T_odom_cam


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def encode_span(keyframe_id: int, span: Span) -> Values:
    """Return the row of what a motion is made of."""
    return (int(keyframe_id), int(span.steps), float(span.angle), float(span.length), encode_array(span.drift))


def decode_span(row: Row) -> Span:
    """Return the span of a row; raises MapCorruptError for one without a covariance."""
    drift = decode_array(row["drift"])
    if drift is None or drift.shape != (6, 6):
        raise MapCorruptError(f"the span of keyframe {row['keyframe_id']} has no covariance")
    return Span(row["steps"], row["angle"], row["length"], drift)
