"""The LocalBus delivers in (stamp, topic, sequence) order, the same every time, and says what failed."""

from concurrent.futures import Future

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.service import topics
from seamark.service.bus import ErrorCode, LocalBus, RemoteError, UnavailableError, WrongKindError
from seamark.service.requests import Done, Empty
from seamark.service.wire import WireError
from seamark.vocab.types import Candidates, PlaceObservation

ACKED = topics.Topic("test", "test", topics.Kind.ACKED, Candidates, "a", ("b", "c"), 4, "For this test.")
OTHER = topics.Topic("other", "other", topics.Kind.ACKED, Candidates, "a", ("b",), 4, "For this test.")
STREAM = topics.Topic("stream", "stream", topics.Kind.STREAM, Candidates, "a", ("b",), 4, "For this test.")
ASK = topics.Topic("ask", "ask", topics.Kind.REQUEST, Candidates, "a", ("b",), 4, "For this test.", reply=Done)


def message(number: int, stamp_ns: int = 0) -> Candidates:
    return Candidates(number, stamp_ns, ())


def test_order_is_stamp_topic_sequence_and_nothing_runs_before_the_pump() -> None:
    a = LocalBus("a")
    b, c, seen = a.for_node("b"), a.for_node("c"), []
    b.handle(ACKED, lambda m: seen.append(("b", "test", m.query_id)))
    c.handle(ACKED, lambda m: seen.append(("c", "test", m.query_id)))
    b.handle(OTHER, lambda m: seen.append(("b", "other", m.query_id)))
    b.subscribe(STREAM, lambda m: seen.append(("b", "stream", m.query_id)))
    a.publish(STREAM, message(4, 7))
    a.send(ACKED, message(1, 7))
    a.send(OTHER, message(2, 7))
    a.send(OTHER, message(3, 9))
    a.publish(STREAM, message(5, 8))
    done = a.send(ACKED, message(6, 8))
    assert seen == [] and not done.done()
    assert a.pump() == 8
    assert seen == [
        ("b", "other", 2),
        ("b", "stream", 4),
        ("b", "test", 1),
        ("c", "test", 1),
        ("b", "stream", 5),
        ("b", "test", 6),
        ("c", "test", 6),
        ("b", "other", 3),
    ]
    assert done.done()


def test_a_stamp_that_runs_backward_never_overtakes_its_topic() -> None:
    a, seen = LocalBus("a"), []
    a.for_node("b").handle(OTHER, lambda m: seen.append(m.query_id))
    for number, stamp_ns in enumerate([100, 50, 200, 1]):
        a.send(OTHER, message(number, stamp_ns))
    a.drain()
    assert seen == [0, 1, 2, 3]


def test_messages_sent_by_handlers_are_delivered_by_the_same_pump() -> None:
    a, seen = LocalBus("a"), []
    b = a.for_node("b")

    def forward(m: Candidates) -> "Future[None]":
        seen.append(("b", m.query_id))
        assert a.pump() == 0  # an inner pump leaves the work to the outer one
        return b.send(OTHER, message(m.query_id + 10, m.stamp_ns))

    b.handle(ACKED, forward)
    a.for_node("c").handle(ACKED, lambda m: seen.append(("c", m.query_id)))
    b.handle(OTHER, lambda m: seen.append(("other", m.query_id)))
    a.send(ACKED, message(1, 1))
    a.send(ACKED, message(2, 2))
    a.drain()
    assert seen == [("b", 1), ("other", 11), ("c", 1), ("b", 2), ("other", 12), ("c", 2)]


@pytest.mark.parametrize("through_wire", [True, False])
def test_requests_are_calls_and_arrays_arrive_read_only_through_the_wire(through_wire: bool) -> None:
    hub = LocalBus(through_wire=through_wire)
    writeable = []

    def rank(observation: PlaceObservation) -> Candidates:
        writeable.append(observation.points.flags.writeable)
        return message(observation.id)

    hub.for_node("vocab").handle(topics.PLACES_RANK, rank)
    grey, points = np.zeros((2, 2), np.uint8), np.zeros((3, 2), np.float32)
    sent = PlaceObservation(5, 0, 0, np.zeros((3, 128), np.uint8), points, grey)
    assert hub.request(topics.PLACES_RANK, sent).query_id == 5
    assert hub.request_async(topics.PLACES_RANK, sent).result().query_id == 5
    assert writeable == [not through_wire] * 2


def test_failures_are_typed() -> None:
    a = LocalBus("a")

    def fail(m: Candidates) -> Done:
        if m.query_id == 0:
            raise SeamarkError("no disk")
        if m.query_id == 1:
            raise WireError("nonsense")
        raise ZeroDivisionError

    with pytest.raises(UnavailableError, match="nobody serves topic ask"):
        a.request(ASK, message(0))
    a.for_node("b").handle(ASK, fail)
    for number, code in enumerate([ErrorCode.FAILED, ErrorCode.INVALID, ErrorCode.INTERNAL]):
        with pytest.raises(RemoteError) as caught:
            a.request(ASK, message(number))
        assert caught.value.code == code
        assert isinstance(a.request_async(ASK, message(number)).exception(), RemoteError)
    a.for_node("b").handle(OTHER, fail)
    a.send(OTHER, message(0))
    with pytest.raises(RemoteError, match="no disk"):
        a.drain()


def test_topics_are_used_as_their_row_says() -> None:
    a = LocalBus("a")
    with pytest.raises(WrongKindError):
        a.send(STREAM, message(0))
    with pytest.raises(WrongKindError):
        a.publish(ACKED, message(0))
    with pytest.raises(WrongKindError):
        a.request(STREAM, message(0))
    with pytest.raises(WrongKindError):
        a.handle(STREAM, print)
    with pytest.raises(WrongKindError, match="a is not a reader of topic ask"):
        a.handle(ASK, lambda m: Done("a"))
    with pytest.raises(WrongKindError):
        a.subscribe(ASK, print)
    with pytest.raises(WireError):
        a.request(ASK, object())


def test_a_closed_node_is_gone() -> None:
    a = LocalBus("a")
    b = a.for_node("b")
    b.handle(ASK, lambda m: Done("b"))
    assert a.request(ASK, message(0)) == Done("b")
    b.close()
    with pytest.raises(UnavailableError):
        a.request(ASK, message(0))


def test_the_table_is_sound() -> None:
    names = [topic.name for topic in topics.TOPICS]
    assert len(set(names)) == len(names)
    keys = [
        topic.key("x", reader)
        for topic in topics.TOPICS
        for reader in (topic.readers if topic.kind is topics.Kind.ACKED else (None,))
    ]
    assert len(set(keys)) == len(keys) and all(key.startswith("seamark/v1/x/") for key in keys)
    for topic in topics.TOPICS:
        assert (topic.reply is not None) == (topic.kind is topics.Kind.REQUEST), topic.name
        assert topic.depth >= 1 and topic.description.endswith((".", "out."))
        assert len(topic.readers) == 1 or topic.kind is topics.Kind.ACKED
    table = topics.markdown_table()
    assert table.count("\n") == len(topics.TOPICS) + 2
    assert "`seamark/v1/NAMESPACE/keyframe/READER` | acked | Keyframe | frontend | vocab, backend" in table
    assert topics.DRAIN["vocab"].message is Empty


@pytest.mark.parametrize("namespace", ["", "a/b", "*", "a$", "x?y", "@a", "#"])
def test_namespaces_are_one_plain_word(namespace: str) -> None:
    with pytest.raises(topics.NamespaceError):
        topics.FRAME.key(namespace)
