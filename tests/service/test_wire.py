"""Messages survive the wire unchanged, hostile bytes raise WireError and nothing else, and version 1 stays readable."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seamark.backend.epipolar import Direction
from seamark.backend.types import Loop, MapSnapshot, Place, Reason
from seamark.frontend.types import Camera, Features, Filled, Frame, Keyframe, Odometry, Outcome, Quality
from seamark.service import messages_pb2 as pb
from seamark.service.requests import Done, Empty, EncodedFrame, Forget, PlaceError, PlaceQuery, PlaceReply, Status
from seamark.service.topics import TOPICS
from seamark.service.wire import SCHEMA_VERSION, SCHEMAS, WireError, decode, encode, encoding_of
from seamark.vocab.confidence import Verdict
from seamark.vocab.types import Candidate, Candidates, PlaceObservation

GOLDEN = Path(__file__).parent / "golden"


def keyframe(number: int = 7) -> Keyframe:
    landmarks = np.array([[0.5, -1, 2], [np.nan] * 3], np.float32)
    features = Features(
        np.array([[1.5, 2], [3, 4.25]], np.float32),
        np.array([2, 4], np.float32),
        np.array([0.25, -0.5], np.float32),
        (np.arange(256, dtype=np.uint16) % 256).astype(np.uint8).reshape(2, 128),
    )
    return Keyframe(
        id=number,
        session=1,
        index=40,
        stamp_ns=1_700_000_000_123_456_789,
        file="rgb/ä 1.png",
        features=features,
        landmarks=landmarks,
        thumbnail=np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        jpeg=b"\xff\xd8\x00\xff\xd9",
        camera=Camera(640, 480, 500.5, 501, 320, 240, (0.1, -0.2, 0.001, 0.002, 0.03)),
        previous_id=0,
        T_odom_cam=np.arange(16.0).reshape(4, 4) / 7,
        covariance=np.eye(6) * 1e-4,
        metric=False,
        depth=b"\x89PNG",
    )


def odometry() -> Odometry:
    return Odometry(
        index=41,
        stamp_ns=-5,
        file="a.png",
        session=0,
        quality=Quality.MARGINAL,
        outcome=Outcome.RECOVERED,
        inliers=33,
        reprojection_px=0.7,
        T_odom_cam=np.eye(4),
        reference_id=0,
        T_reference_cam=np.eye(4) * 2,
        covariance=np.full((6, 6), np.nan),
        keyframe_id=None,
        filled=(Filled(3, 30, 0, 1, np.eye(4) * 3),),
        tracks=np.ones((5, 4), np.float32),
        stages_ms={"track": 7.5, "detect": 1.25},
    )


def loop(accepted: bool = True) -> Loop:
    pose = np.eye(4) if accepted else None
    reason = Reason.ACCEPTED if accepted else Reason.FEW_MATCHES
    return Loop(9, 2, accepted, reason, 50, 0.9, 0.5, float("nan"), pose, None, 1.5)


def messages() -> list[Any]:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    snapshot = MapSnapshot(
        4, *(np.arange(2) + k for k in range(3)), np.full((2, 4, 4), np.nan), np.ones(2), (loop(), loop(False))
    )
    empty_map = MapSnapshot(0, *(np.zeros(0, np.int64),) * 3, np.zeros((0, 4, 4)), np.zeros(0), ())
    direction = Direction(np.eye(3), np.array([0.0, 0.6, 0.8]), 0.01, 0.02)
    bare = dataclasses.replace(
        keyframe(),
        features=Features.empty(),
        landmarks=np.zeros((0, 3), np.float32),
        camera=None,
        previous_id=None,
        T_odom_cam=None,
        covariance=None,
        depth=b"",
    )
    return [
        Frame(0, 10, grey),
        Frame(1, 11, np.stack([grey] * 3, axis=-1), grey, np.array([[0, np.nan]], np.float32), "f"),
        Frame(2, 12, grey, None, grey.astype(np.uint16), mask=grey),
        EncodedFrame(3, 13, b"jpeg", None, b"png", "g"),
        EncodedFrame(4, 14, grey, b"right", None, mask=b"png"),
        keyframe(),
        bare,
        odometry(),
        Odometry(0, 0, "", -1, Quality.LOST, Outcome.UNREADABLE),
        Candidates(-1, 5, (Candidate(1, 0.5, 0.25, float("nan")), Candidate(0, 0.1, 0, 3, 0.75))),
        Candidates(3, 5, ()),
        Forget(np.array([3, 1, 4], np.int64)),
        PlaceObservation(1, 0, 9, np.zeros((2, 128), np.uint8), np.zeros((2, 2), np.float32), grey),
        PlaceObservation(
            1, 0, 9, np.zeros((2, 128), np.uint8), np.zeros((2, 2), np.float32), grey, *np.ones((2, 2), np.float32)
        ),
        loop(),
        loop(False),
        snapshot,
        empty_map,
        PlaceQuery(b"image", 3, Camera(64, 48, 50, 50, 32, 24)),
        PlaceQuery(b"", 1),
        PlaceReply(
            (
                Place(1, 0, 5, "a", 0.5, 0.4, 0.1, 30, True, Reason.ACCEPTED, np.eye(4), 0.4, 0.99),
                Place(2, 0, 5, "b", 0.5, 0.4, 0.1, 30, True, Reason.ACCEPTED, direction=direction),
            ),
            timings_ms={"sift": 9.5},
            verdict=Verdict.ACCEPTED,
        ),
        PlaceReply((), PlaceError.NO_FEATURES, "the image is blank", verdict=Verdict.NO_FEATURES),
        Empty(),
        Done("vocab"),
        Status("backend", 12, 10**10, 2 * 10**10, 1.5, {"loops": 3}, {"verify": [1.0, 2.0], "none": []}),
    ]


def assert_equal(left: Any, right: Any) -> None:
    """Compare two messages field by field; NaN equals NaN, None only None."""
    if isinstance(left, np.ndarray):
        assert left.dtype == right.dtype and left.shape == right.shape
        np.testing.assert_array_equal(left, right)
    elif dataclasses.is_dataclass(left):
        assert type(left) is type(right)
        for field in dataclasses.fields(left):
            assert_equal(getattr(left, field.name), getattr(right, field.name))
    elif isinstance(left, tuple):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            assert_equal(one, other)
    else:
        assert (left is None) == (right is None)
        assert left == right or (left != left and right != right)


@pytest.mark.parametrize("message", messages(), ids=lambda message: type(message).__name__)
def test_round_trip(message: Any) -> None:
    assert_equal(decode(encode(message), type(message)), message)


def test_every_message_type_is_tried_and_every_topic_can_be_sent() -> None:
    assert {type(message) for message in messages()} == set(SCHEMAS)
    for topic in TOPICS:
        assert topic.message in SCHEMAS
        assert topic.reply is None or topic.reply in SCHEMAS


def test_every_field_of_every_dataclass_travels() -> None:
    for kind, schema in SCHEMAS.items():
        local = {"evidence"} if kind is Loop else set()  # it goes from the back end to the map and nowhere else
        assert {field.name for field in dataclasses.fields(kind)} - local == set(schema.fields), kind


def test_arrays_arrive_read_only() -> None:
    received = decode(encode(keyframe()), Keyframe)
    for array in (received.landmarks, received.features.points, received.thumbnail, received.T_odom_cam):
        assert array is not None and not array.flags.writeable
    empty = decode(encode(messages()[6]), Keyframe)
    assert not empty.landmarks.flags.writeable


def test_missing_is_none_and_not_zero() -> None:
    received = decode(encode(odometry()), Odometry)
    assert received.reference_id == 0 and received.keyframe_id is None


def test_big_endian_and_strided_arrays_arrive_as_they_look() -> None:
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)[::2, ::-1]
    depth = np.arange(12, dtype=">u2").reshape(3, 4)
    received = decode(encode(Frame(0, 0, image, None, depth)), Frame)
    np.testing.assert_array_equal(received.image, image)
    np.testing.assert_array_equal(received.depth, depth)


@pytest.mark.parametrize(
    "name, message",
    [
        ("keyframe_v1.bin", dataclasses.replace(keyframe(), depth=b"")),
        ("keyframe_with_depth_v1.bin", keyframe()),
        ("odometry_v1.bin", odometry()),
    ],
)
def test_version_1_stays_readable(name: str, message: Any) -> None:
    assert_equal(decode((GOLDEN / name).read_bytes(), type(message)), message)


@pytest.mark.parametrize("kind", SCHEMAS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("data", [b"", b"\x00", b"\xff" * 40, b"\x08\x02", b"\x08\x01\x12"])
def test_bad_bytes_raise(kind: type, data: bytes) -> None:
    with pytest.raises(WireError):
        decode(data, kind)


def test_unknown_version_is_named() -> None:
    with pytest.raises(WireError, match=f"Done has schema version 2; {SCHEMA_VERSION} is known"):
        decode(pb.Done(schema_version=2, node="x").SerializeToString(), Done)


HOSTILE_ARRAYS = [
    pb.Array(data=b"1234", shape=[2, 2], dtype="object"),
    pb.Array(data=b"1234", shape=[2, 2], dtype=""),
    pb.Array(data=b"123", shape=[2, 2], dtype="uint8"),
    pb.Array(data=b"12345", shape=[2, 2], dtype="uint8"),
    pb.Array(data=b"1234", shape=[4], dtype="uint8"),
    pb.Array(data=b"1234", shape=[1, 1, 4], dtype="uint8"),
    pb.Array(data=b"", shape=[2**32 - 1, 2**32 - 1], dtype="uint8"),
    pb.Array(data=b"", shape=[0] * 40, dtype="uint8"),
    pb.Array(data=b"12345678", shape=[2, 2], dtype="uint16"),
]


@pytest.mark.parametrize("array", HOSTILE_ARRAYS, ids=str)
def test_hostile_arrays_raise(array: pb.Array) -> None:
    data = pb.Frame(schema_version=1, image=pb.Image(raw=array)).SerializeToString()
    with pytest.raises(WireError, match="image"):
        decode(data, Frame)


def test_contradicting_lengths_raise() -> None:
    message = pb.Keyframe.FromString(encode(keyframe()))
    message.landmarks.shape[0] = 1
    message.landmarks.data = message.landmarks.data[:12]
    with pytest.raises(WireError, match="1 landmarks for 2 features"):
        decode(message.SerializeToString(), Keyframe)


@pytest.mark.parametrize(
    "value, word",
    [
        (object(), "object is not a message"),
        (PlaceQuery(b"", -1), "top_k"),
        (dataclasses.replace(odometry(), index=2**63), "index"),
        (dataclasses.replace(odometry(), T_odom_cam=np.eye(3)), "T_odom_cam"),
        (dataclasses.replace(odometry(), quality="splendid"), "quality"),
        (dataclasses.replace(odometry(), file=None, index=None), "index"),
        (Frame(0, 0, np.zeros((2, 2), np.int64)), "image: dtype"),  # type: ignore[arg-type]
        (EncodedFrame(0, 0, b"0" * (65 * 1024 * 1024)), "larger than"),
    ],
)
def test_what_cannot_be_sent_is_named(value: object, word: str) -> None:
    with pytest.raises(WireError, match=word):
        encode(value)


def test_file_names_that_are_not_unicode_can_be_sent() -> None:
    sent = dataclasses.replace(odometry(), file="a\udcff.png")
    assert decode(encode(sent), Odometry).file == "a?.png"


def test_encoding_names_the_message() -> None:
    assert encoding_of(Keyframe) == "application/protobuf;seamark.v1.Keyframe"
    assert encoding_of(EncodedFrame) == encoding_of(Frame)


BLOBS = [(type(message), encode(message)) for message in messages()]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(data=st.data())
def test_fuzzed_bytes_decode_or_raise_wire_error(data: st.DataObject) -> None:
    kind, blob = data.draw(st.sampled_from(BLOBS))
    action = data.draw(st.sampled_from(["cut", "change", "random", "join"]))
    if action == "cut":
        blob = blob[: data.draw(st.integers(0, len(blob)))]
    elif action == "random":
        blob = data.draw(st.binary(max_size=200))
    elif action == "join":
        blob = blob + data.draw(st.sampled_from(BLOBS))[1]
    else:
        changed = bytearray(blob)
        for _ in range(data.draw(st.integers(1, 5))):
            changed[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
        blob = bytes(changed)
    try:
        assert isinstance(decode(blob, kind), (kind, EncodedFrame, Frame))
    except WireError as error:
        assert kind.__name__ in str(error)


def test_what_was_added_may_be_missing_from_an_older_message() -> None:
    old = pb.PlaceReply(schema_version=1, error_message="")
    old.places.add(keyframe_id=3, reason="accepted", accepted=True)
    reply = decode(old.SerializeToString(), PlaceReply)
    assert reply.verdict is None and reply.places[0].view == reply.places[0].probability == 0.0
    ranked = pb.Candidates(schema_version=1, query_id=2)
    ranked.ranked.add(id=1, score=0.5)
    assert decode(ranked.SerializeToString(), Candidates).ranked == (Candidate(1, 0.5, 0.0, 0.0, 0.0),)


def test_an_unknown_verdict_is_malformed() -> None:
    with pytest.raises(WireError, match="PlaceReply"):
        decode(pb.PlaceReply(schema_version=1, verdict="perhaps").SerializeToString(), PlaceReply)
