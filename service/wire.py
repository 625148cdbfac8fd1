"""Messages as bytes: Protobuf, arrays as bytes with shape and dtype, one table that says how each type travels.

What arrives is hostile until proven otherwise: anything that is not a complete message of the expected type and of a
known schema version raises :class:`WireError`, and nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from google.protobuf.message import DecodeError, Message

from seamark import SeamarkError
from seamark.backend.epipolar import Direction
from seamark.backend.types import Loop, MapSnapshot, Place, Reason
from seamark.frontend.types import Camera, Features, Filled, Frame, Keyframe, Loss, Odometry, Outcome, Quality
from seamark.service import messages_pb2 as pb
from seamark.service.requests import Done, Empty, EncodedFrame, Forget, PlaceError, PlaceQuery, PlaceReply, Status
from seamark.service.wire_fields import (
    Array,
    Blob,
    Field,
    Flag,
    Integer,
    MalformedFieldError,
    Map,
    Nested,
    Number,
    Numbers,
    Optional,
    Picture,
    Repeated,
    Text,
    Word,
)
from seamark.vocab.confidence import Verdict
from seamark.vocab.types import Candidate, Candidates, PlaceObservation

SCHEMA_VERSION = 1
MAX_MESSAGE_BYTES = 64 * 1024 * 1024

T = TypeVar("T")


class WireError(SeamarkError):
    """Bytes are not a message of the expected type and version, or a value cannot become one."""


@dataclass(frozen=True)
class Schema:
    """How one Python type travels: its Protobuf message, its fields, and what makes the value from them."""

    message: type[Message]
    fields: dict[str, Field]
    build: Callable[..., Any]

    def pack(self, value: object) -> Message:
        """Return the Protobuf message of a value."""
        message = self.message()
        for name, codec in self.fields.items():
            try:
                codec.put(message, name, getattr(value, name))
            except (ValueError, TypeError, AttributeError) as error:
                raise MalformedFieldError(f"{name}: {error}") from error
        return message

    def unpack(self, message: Message) -> Any:
        """Return the value of a Protobuf message."""
        values: dict[str, Any] = {}
        for name, codec in self.fields.items():
            try:
                values[name] = codec.get(message, name)
            except ValueError as error:
                raise MalformedFieldError(f"{name}: {error}") from error
        return self.build(**values)


def _frame(**fields: Any) -> Frame | EncodedFrame:
    pictures = (fields[name] for name in ("image", "image_right", "depth", "mask"))
    return EncodedFrame(**fields) if any(isinstance(picture, bytes) for picture in pictures) else Frame(**fields)


def _features(**fields: Any) -> Features:
    if len({len(values) for values in fields.values()}) != 1:
        raise MalformedFieldError(f"arrays of different lengths {[len(values) for values in fields.values()]}")
    return Features(**fields)


def _keyframe(**fields: Any) -> Keyframe:
    if len(fields["features"]) != len(fields["landmarks"]):
        raise MalformedFieldError(f"{len(fields['landmarks'])} landmarks for {len(fields['features'])} features")
    return Keyframe(**fields)


def _observation(**fields: Any) -> PlaceObservation:
    if len(fields["descriptors"]) != len(fields["points"]):
        raise MalformedFieldError(f"{len(fields['points'])} points for {len(fields['descriptors'])} descriptors")
    for name in ("scales", "angles"):
        if fields[name] is not None and len(fields[name]) != len(fields["descriptors"]):
            raise MalformedFieldError(f"{len(fields[name])} {name} for {len(fields['descriptors'])} descriptors")
    return PlaceObservation(**fields)


def _snapshot(**fields: Any) -> MapSnapshot:
    arrays = ("keyframe_ids", "sessions", "components", "T_map_cam", "scales")
    if len({len(fields[name]) for name in arrays}) != 1:
        raise MalformedFieldError(f"arrays of different lengths {[len(fields[name]) for name in arrays]}")
    return MapSnapshot(**fields)


def _query(**fields: Any) -> PlaceQuery:
    if not 1 <= fields["top_k"] <= 1000:
        raise MalformedFieldError(f"top_k is {fields['top_k']}; 1 to 1000 are possible")
    return PlaceQuery(**fields)


_POSE = Array(("float64",), (4, 4))
_COVARIANCE = Array(("float64",), (6, 6))
_THUMBNAIL = Array(("uint8",), (None, None), (None, None, 3))
_POINTS = Array(("float32",), (None, 2))
_DESCRIPTORS = Array(("uint8",), (None, 128))
_IDS = Array(("int64",), (None,))

_CAMERA = Schema(
    pb.Camera,
    {name: Integer() for name in ("width", "height")}
    | {name: Number() for name in ("fx", "fy", "cx", "cy")}
    | {"distortion": Numbers()},
    Camera,
)
_FEATURES = Schema(
    pb.Features,
    {
        "points": _POINTS,
        "scales": Array(("float32",), (None,)),
        "angles": Array(("float32",), (None,)),
        "descriptors": _DESCRIPTORS,
    },
    _features,
)
_FILLED = Schema(
    pb.Filled,
    {name: Integer() for name in ("index", "stamp_ns", "session", "reference_id")} | {"T_reference_cam": _POSE},
    Filled,
)
_CANDIDATE = Schema(
    pb.Candidate, {"id": Integer()} | {name: Number() for name in ("score", "votes", "jeffrey", "view")}, Candidate
)
_EVIDENCE: dict[str, Field] = {"score": Number(), "votes": Number(), "jeffrey": Number(), "inliers": Integer()}
_VERDICT: dict[str, Field] = {"accepted": Flag(), "reason": Word(Reason)}
_LOOP = Schema(
    pb.Loop,
    {"query_id": Integer(), "match_id": Integer()}
    | _VERDICT
    | _EVIDENCE
    | {"T_match_query": Optional(_POSE), "covariance": Optional(_COVARIANCE), "scale": Number()},
    Loop,
)
_DIRECTION = Schema(
    pb.Direction,
    {
        "R_match_query": Array(("float64",), (3, 3)),
        "bearing": Array(("float64",), (3,)),
        "rotation_sigma": Number(),
        "bearing_sigma": Number(),
    },
    Direction,
)
_PLACE = Schema(
    pb.Place,
    {"keyframe_id": Integer(), "session": Integer(), "stamp_ns": Integer(), "file": Text()}
    | _VERDICT
    | _EVIDENCE
    | {"T_map_cam": Optional(_POSE), "view": Number(), "probability": Number()}
    | {"direction": Optional(Nested(_DIRECTION))},
    Place,
)
_COLOUR = Array(("uint8",), (None, None), (None, None, 3))
_FRAME = Schema(
    pb.Frame,
    {
        "index": Integer(),
        "stamp_ns": Integer(),
        "file": Text(),
        "image": Picture(_COLOUR),
        "image_right": Optional(Picture(_COLOUR)),
        "depth": Optional(Picture(Array(("uint16", "float32"), (None, None)))),
        "mask": Optional(Picture(Array(("uint8",), (None, None)))),
    },
    _frame,
)

#: How every message that travels alone does so.
SCHEMAS: dict[type, Schema] = {
    Frame: _FRAME,
    EncodedFrame: _FRAME,
    Keyframe: Schema(
        pb.Keyframe,
        {name: Integer() for name in ("id", "session", "index", "stamp_ns")}
        | {
            "file": Text(),
            "features": Nested(_FEATURES),
            "landmarks": Array(("float32",), (None, 3)),
            "thumbnail": _THUMBNAIL,
            "jpeg": Blob(),
            "camera": Optional(Nested(_CAMERA)),
            "previous_id": Optional(Integer()),
            "T_odom_cam": Optional(_POSE),
            "covariance": Optional(_COVARIANCE),
            "metric": Flag(),
            "depth": Blob(),
        },
        _keyframe,
    ),
    Odometry: Schema(
        pb.Odometry,
        {name: Integer() for name in ("index", "stamp_ns", "session", "inliers")}
        | {
            "file": Text(),
            "quality": Word(Quality),
            "outcome": Word(Outcome),
            "reprojection_px": Number(),
            "latency_ms": Number(),
            "T_odom_cam": Optional(_POSE),
            "reference_id": Optional(Integer()),
            "T_reference_cam": Optional(_POSE),
            "covariance": Optional(_COVARIANCE),
            "keyframe_id": Optional(Integer()),
            "filled": Repeated(_FILLED),
            "tracks": Array(("float32",), (None, 4)),
            "stages_ms": Map("ms", number=True),
            "near_share": Optional(Number()),
            "loss": Optional(Word(Loss)),
            "track_ages": Optional(Array(("int32",), (None,))),
            "motion_mask": Optional(Array(("uint8",), (None, None))),
        },
        Odometry,
    ),
    PlaceObservation: Schema(
        pb.PlaceObservation,
        {name: Integer() for name in ("id", "session", "stamp_ns")}
        | {"descriptors": _DESCRIPTORS, "points": _POINTS, "thumbnail": _THUMBNAIL}
        | dict.fromkeys(("scales", "angles"), Optional(Array(("float32",), (None,)))),
        _observation,
    ),
    Candidates: Schema(
        pb.Candidates, {"query_id": Integer(), "stamp_ns": Integer(), "ranked": Repeated(_CANDIDATE)}, Candidates
    ),
    Loop: _LOOP,
    MapSnapshot: Schema(
        pb.MapSnapshot,
        {"revision": Integer()}
        | dict.fromkeys(("keyframe_ids", "sessions", "components"), _IDS)
        | {
            "T_map_cam": Array(("float64",), (None, 4, 4)),
            "scales": Array(("float64",), (None,)),
            "loops": Repeated(_LOOP),
        },
        _snapshot,
    ),
    PlaceQuery: Schema(
        pb.PlaceQuery, {"image": Blob(), "top_k": Integer(), "camera": Optional(Nested(_CAMERA))}, _query
    ),
    PlaceReply: Schema(
        pb.PlaceReply,
        {
            "places": Repeated(_PLACE),
            "error_code": Optional(Word(PlaceError)),
            "error_message": Text(),
            "timings_ms": Map("ms", number=True),
            "verdict": Optional(Word(Verdict)),
        },
        PlaceReply,
    ),
    Empty: Schema(pb.Empty, {}, Empty),
    Forget: Schema(pb.Forget, {"keyframe_ids": _IDS}, Forget),
    Done: Schema(pb.Done, {"node": Text()}, Done),
    Status: Schema(
        pb.Status,
        {name: Integer() for name in ("pid", "rss_bytes", "peak_rss_bytes")}
        | {
            "node": Text(),
            "cpu_s": Number(),
            "counters": Map("count", number=False),
            "stages_ms": Map("ms", number=None),
        },
        Status,
    ),
}


def encoding_of(kind: type) -> str:
    """Return the name by which Zenoh announces the content of a message type."""
    return f"application/protobuf;{SCHEMAS[kind].message.DESCRIPTOR.full_name}"


def encode(value: object) -> bytes:
    """Return the bytes of a message; raises WireError when a field cannot travel or the whole is too large."""
    schema = SCHEMAS.get(type(value))
    if schema is None:
        raise WireError(f"{type(value).__name__} is not a message")
    try:
        message = cast(Any, schema.pack(value))
        message.schema_version = SCHEMA_VERSION
        data = cast(bytes, message.SerializeToString(deterministic=True))
    except (ValueError, SeamarkError) as error:
        raise WireError(f"{type(value).__name__} cannot be sent: {error}") from error
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"{type(value).__name__} of {len(data)} bytes is larger than {MAX_MESSAGE_BYTES}")
    return data


def decode(data: bytes, kind: type[T]) -> T:
    """Return the message of type ``kind`` in bytes, with read-only arrays; raises WireError for anything else."""
    schema, name = SCHEMAS[kind], kind.__name__
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"{name} of {len(data)} bytes is larger than {MAX_MESSAGE_BYTES}")
    try:
        message = cast(Any, schema.message).FromString(data)
    except DecodeError as error:
        raise WireError(f"{name} cannot be read: {error}") from error
    if message.schema_version != SCHEMA_VERSION:
        raise WireError(f"{name} has schema version {message.schema_version}; {SCHEMA_VERSION} is known")
    try:
        return cast(T, schema.unpack(message))
    except (ValueError, SeamarkError) as error:
        raise WireError(f"{name} is malformed: {error}") from error
