"""The vocabulary node over Zenoh, given rubbish: a typed error, a counter, a line in the log, and it goes on."""

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from seamark.frontend.types import Features, Keyframe
from seamark.service import messages_pb2 as pb
from seamark.service import topics
from seamark.service.nodes.vocab_node import VocabNode
from seamark.service.requests import Empty, Status
from seamark.service.wire import encode
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_delivery import pack_stamp
from seamark.service.zenoh_session import free_endpoint, open_session
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

pytestmark = pytest.mark.zenoh
NAMESPACE, PATIENCE_S = "x", 20.0
RANDOM = np.random.default_rng(0)
WORDS = Vocabulary(RANDOM.integers(0, 256, (64, 128), dtype=np.uint8), np.ones(64, np.float32))
PICTURE = RANDOM.integers(0, 256, (12, 16, 3), dtype=np.uint8)
SOUND = PlaceObservation(-1, 1, 0, np.asarray(WORDS.words[:20]), np.zeros((20, 2), np.float32), PICTURE)


@pytest.fixture
def node() -> Iterator[tuple[Any, ZenohBus]]:
    """The router's session, which sends anything to the node, and the bus of the runner."""
    endpoint = free_endpoint()
    router = open_session("router", listen=[endpoint])
    sessions = [open_session("client", connect=[endpoint]) for _ in range(3)]
    names = (topics.VOCAB, topics.BACKEND, topics.RUNNER)
    bus, backend, runner = (ZenohBus(*one, NAMESPACE) for one in zip(sessions, names, strict=True))
    backend.handle(topics.CANDIDATES, lambda _: None)
    VocabNode(bus, PlaceIndex(WORDS))
    deadline = time.monotonic() + PATIENCE_S
    while not runner.matched(topics.STATUS[topics.VOCAB]):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    yield router, runner
    for one in (bus, backend, runner):
        one.close()
    for session in (*sessions, router):
        session.close()


def ask(router: Any, topic: topics.Topic, payload: bytes, number: int | None = None) -> str:
    """Return the reply to raw bytes, ``ok`` for a good one; ``number`` is that of an acked message."""
    reader = topics.VOCAB if topic.kind is topics.Kind.ACKED else None
    stamp = None if number is None else pack_stamp(SENDER, number, 0)
    replies = router.get(topic.key(NAMESPACE, reader), payload=payload, attachment=stamp, timeout=PATIENCE_S)
    said = [reply.err.payload.to_string() if reply.ok is None else "ok" for reply in replies]
    assert len(said) == 1
    return str(said[0])


SENDER = UUID(int=7)


def count(runner: ZenohBus, name: str) -> int:
    status = runner.request(topics.STATUS[topics.VOCAB], Empty(), PATIENCE_S)
    assert isinstance(status, Status)
    return status.counters.get(name, 0)


def spoilt(change: Callable[[Any], object]) -> bytes:
    message = pb.PlaceObservation.FromString(encode(SOUND))
    change(message)
    return bytes(message.SerializeToString())


def floats(message: Any) -> None:
    """Descriptors as another program computes them: float32, some not a number."""
    values = np.full((20, 128), np.nan, np.float32)
    message.descriptors.dtype, message.descriptors.data = "float32", values.tobytes()


def narrow(message: Any) -> None:
    """ORB descriptors, 32 bytes each: another vocabulary's."""
    message.descriptors.shape[:] = [20, 32]
    message.descriptors.data = bytes(20 * 32)


def cut(message: Any) -> None:
    message.descriptors.data = message.descriptors.data[:-1]


def fewer_points(message: Any) -> None:
    message.points.shape[:] = [19, 2]
    message.points.data = bytes(19 * 8)


def more_angles(message: Any) -> None:
    message.angles.dtype, message.angles.data = "float32", bytes(21 * 4)
    message.angles.shape.extend([21])


def newer(message: Any) -> None:
    message.schema_version = 99


RUBBISH = {
    "floats": (spoilt(floats), "INVALID", "dtype"),
    "narrow": (spoilt(narrow), "INVALID", "shape"),
    "cut": (spoilt(cut), "INVALID", "bytes"),
    "fewer_points": (spoilt(fewer_points), "INVALID", "19 points"),
    "more_angles": (spoilt(more_angles), "INVALID", "21 angles"),
    "newer": (spoilt(newer), "INVALID", "schema version 99"),
    "noise": (b"\xff" * 100, "INVALID", "cannot be read"),
    "no_picture": (encode(replace(SOUND, thumbnail=np.zeros((0, 4), np.uint8))), "FAILED", "thumbnail"),
}


def test_rubbish_is_refused_counted_and_told(node: tuple[Any, ZenohBus], caplog: pytest.LogCaptureFixture) -> None:
    router, runner = node
    refused = f"{topics.PLACES_RANK.name}_refused"
    with caplog.at_level(logging.WARNING):
        for number, (payload, code, what) in enumerate(RUBBISH.values(), start=1):
            said = ask(router, topics.PLACES_RANK, payload)
            assert code in said and what in said
            assert count(runner, refused) == number
    told = [record.getMessage() for record in caplog.records if "refused on topic" in record.getMessage()]
    assert len(told) == 4 and "message 8" in told[-1]  # the first, second, fourth and eighth
    assert all(topics.PLACES_RANK.name in line for line in told) and "dtype" in told[0]
    assert ask(router, topics.PLACES_RANK, encode(SOUND)) == "ok"
    assert count(runner, refused) == len(RUBBISH)


def test_a_keyframe_of_rubbish_is_refused_and_the_next_one_becomes_a_place(node: tuple[Any, ZenohBus]) -> None:
    router, runner = node
    message = pb.Keyframe.FromString(encode(keyframe(0)))
    message.features.descriptors.shape[:] = [20, 64]
    message.features.descriptors.data = bytes(20 * 64)
    assert "INVALID" in ask(router, topics.KEYFRAME, bytes(message.SerializeToString()), 0)
    assert "INVALID" in ask(router, topics.KEYFRAME, b"\xff", 1)
    assert count(runner, f"{topics.KEYFRAME.name}_refused") == 2 and count(runner, "places") == 0
    assert ask(router, topics.KEYFRAME, encode(keyframe(1)), 2) == "ok"
    assert count(runner, "places") == 1


def keyframe(number: int) -> Keyframe:
    features = Features(
        np.zeros((20, 2), np.float32), np.ones(20, np.float32), np.zeros(20, np.float32), SOUND.descriptors
    )
    landmarks = np.full((20, 3), np.nan, np.float32)
    return Keyframe(number, 0, number, number, "", features, landmarks, PICTURE, b"jpeg")
