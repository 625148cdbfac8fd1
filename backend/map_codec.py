"""Keyframes and loops to and from the columns of a map on disk."""

import json
import sqlite3
import zlib
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import MapCorruptError
from seamark.backend.types import Loop, Reason
from seamark.frontend.camera import Camera
from seamark.frontend.types import Features, Keyframe

_DTYPES = {"f4": np.float32, "f8": np.float64, "u1": np.uint8}
_ARRAY_COLUMNS = ("points", "scales", "angles", "descriptors", "landmarks", "thumbnail")
KEYFRAME_COLUMNS = (
    *("id", "session", "frame_index", "stamp_ns", "file", "previous_id", "metric", "camera", "T_odom_cam"),
    *("covariance", *_ARRAY_COLUMNS, "jpeg", "checksum"),
)
LOOP_COLUMNS = (
    *("query_id", "match_id", "accepted", "reason", "inliers", "score", "votes", "jeffrey"),
    *("T_match_query", "covariance", "scale", "checksum"),
)


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
    """Return the read-only array of :func:`encode_array`."""
    if blob is None:
        return None
    header, _, data = blob.partition(b"\n")
    code, *shape = header.decode().split()
    return np.frombuffer(data, _DTYPES[code]).reshape([int(n) for n in shape])


def encode_keyframe(keyframe: Keyframe) -> tuple[Any, ...]:
    """Return the values of KEYFRAME_COLUMNS."""
    features = keyframe.features
    camera = None if keyframe.camera is None else json.dumps(asdict(keyframe.camera))
    values = (
        *(int(keyframe.id), int(keyframe.session), int(keyframe.index), int(keyframe.stamp_ns), keyframe.file),
        None if keyframe.previous_id is None else int(keyframe.previous_id),
        *(int(keyframe.metric), camera, encode_array(keyframe.T_odom_cam), encode_array(keyframe.covariance)),
        *(encode_array(features.points), encode_array(features.scales), encode_array(features.angles)),
        *(encode_array(features.descriptors), encode_array(keyframe.landmarks), encode_array(keyframe.thumbnail)),
        keyframe.jpeg,
    )
    return (*values, checksum(values))


def decode_keyframe(row: sqlite3.Row) -> Keyframe:
    """Return the keyframe of a row; raises MapCorruptError when the checksum differs."""
    check_row(row, f"keyframe {row['id']}")
    arrays = {name: decode_array(row[name]) for name in _ARRAY_COLUMNS}
    camera = None
    if row["camera"] is not None:
        stored = json.loads(row["camera"])
        camera = Camera(**{**stored, "distortion": tuple(stored["distortion"])})
    return Keyframe(
        id=row["id"],
        session=row["session"],
        index=row["frame_index"],
        stamp_ns=row["stamp_ns"],
        file=row["file"],
        features=Features(arrays["points"], arrays["scales"], arrays["angles"], arrays["descriptors"]),  # type: ignore[arg-type]
        landmarks=arrays["landmarks"],  # type: ignore[arg-type]
        thumbnail=arrays["thumbnail"],  # type: ignore[arg-type]
        jpeg=row["jpeg"],
        camera=camera,
        previous_id=row["previous_id"],
        T_odom_cam=decode_array(row["T_odom_cam"]),
        covariance=decode_array(row["covariance"]),
        metric=bool(row["metric"]),
    )


def encode_loop(loop: Loop) -> tuple[Any, ...]:
    """Return the values of LOOP_COLUMNS."""
    values = (
        *(int(loop.query_id), int(loop.match_id), int(loop.accepted), loop.reason.value, int(loop.inliers)),
        *(float(loop.score), float(loop.votes), float(loop.jeffrey)),
        *(encode_array(loop.T_match_query), encode_array(loop.covariance), float(loop.scale)),
    )
    return (*values, checksum(values))


def decode_loop(row: sqlite3.Row) -> Loop:
    """Return the loop of a row; raises MapCorruptError when the checksum differs."""
    check_row(row, f"loop {row['query_id']} to {row['match_id']}")
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


def checksum(values: tuple[Any, ...]) -> int:
    """Return the CRC-32 of a row's values; names and lengths keep them apart."""
    crc = 0
    for value in values:
        if isinstance(value, float) and value != value:
            value = None  # SQLite stores a NaN as NULL
        data = value if isinstance(value, bytes) else repr(value).encode()
        crc = zlib.crc32(f"{type(value).__name__} {len(data)}\n".encode() + data, crc)
    return crc


def check_row(row: sqlite3.Row, name: str) -> None:
    """Raise MapCorruptError unless the last column is the checksum of the others."""
    *values, expected = tuple(row)
    if checksum(tuple(values)) != expected:
        raise MapCorruptError(f"{name} of the map is damaged: its checksum differs")


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
