"""ZenohBus in one process: order, exactly once, resending, refusals, limits, and no failed callback."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
import zenoh

from seamark import SeamarkError
from seamark.frontend.types import Frame
from seamark.service import topics
from seamark.service.bus import (
    BusClosedError,
    ErrorCode,
    RemoteError,
    TimedOutError,
    UnavailableError,
)
from seamark.service.requests import Done, PlaceQuery
from seamark.service.wire import MAX_MESSAGE_BYTES, encode
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_delivery import pack_stamp
from seamark.service.zenoh_session import SessionError, Watch, announce, free_endpoint, open_session
from seamark.vocab.types import Candidates

ACKED = topics.Topic("test", "test", topics.Kind.ACKED, Candidates, "a", ("b",), 4, "For this test.")
BOTH = topics.Topic("both", "both", topics.Kind.ACKED, Candidates, "a", ("b", "c"), 4, "For this test.")
NEXT = topics.Topic("next", "next", topics.Kind.ACKED, Candidates, "b", ("c",), 4, "For this test.")
STREAM = topics.Topic("stream", "stream", topics.Kind.STREAM, Candidates, "a", ("b",), 1, "For this test.")
ASK = topics.Topic("ask", "ask", topics.Kind.REQUEST, Candidates, "a", ("b",), 1, "For this test.", reply=Done)
LOOP_BACK = topics.Topic("back", "back", topics.Kind.REQUEST, Candidates, "b", ("a",), 1, "For this test.", reply=Done)
FRAMES = topics.Topic("f", "f", topics.Kind.REQUEST, Frame, "a", ("b",), 16, "For this test.", reply=Candidates)
PICTURE = topics.Topic("p", "p", topics.Kind.REQUEST, PlaceQuery, "a", ("b",), 4, "For this test.", reply=Done)
PATIENCE_S = 20.0


def message(number: int) -> Candidates:
    return Candidates(number, number * 10, ())


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.001)


@pytest.fixture(autouse=True)
def no_failed_callbacks(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Zenoh only logs the exceptions of callbacks."""
    yield
    assert [record for record in caplog.get_records("call") if record.name == "zenoh.handlers"] == []


class Net:
    """A router and the nodes around it."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.router = open_session("router", listen=[self.endpoint])
        self._open: list[tuple[ZenohBus, Any]] = []

    def bus(self, node: str) -> ZenohBus:
        session = open_session("client", connect=[self.endpoint])
        self._open.append((ZenohBus(session, node, "x"), session))
        return self._open[-1][0]

    def close(self, bus: ZenohBus) -> None:
        for entry in [entry for entry in self._open if entry[0] is bus]:
            entry[0].close()
            entry[1].close()
            self._open.remove(entry)

    def close_all(self) -> None:
        for bus, _ in reversed(list(self._open)):
            self.close(bus)
        self.router.close()


@pytest.fixture
def net() -> Iterator[Net]:
    net = Net()
    yield net
    net.close_all()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("outbox", "a-", "b-", "c-"))]


def test_acked_messages_arrive_in_order_once_at_every_reader(net: Net) -> None:
    a, b, c = net.bus("a"), net.bus("b"), net.bus("c")
    at_b: list[int] = []
    at_c: list[int] = []
    b.handle(BOTH, lambda m: at_b.append(m.query_id))
    c.handle(BOTH, lambda m: at_c.append(m.query_id))
    futures = [a.send(BOTH, message(number)) for number in range(200)]
    a.drain(PATIENCE_S)
    assert at_b == at_c == list(range(200))
    wait_until(lambda: all(future.done() for future in futures))


def test_what_was_sent_before_the_reader_came_arrives(net: Net) -> None:
    a, seen = net.bus("a"), []
    for number in range(3):
        a.send(ACKED, message(number))
    wait_until(lambda: a.resent > 0)
    with pytest.raises(TimedOutError, match="3 messages to seamark/v1/x/test/b are not acknowledged"):
        a.drain(0.0)
    net.bus("b").handle(ACKED, lambda m: seen.append(m.query_id))
    a.drain(PATIENCE_S)
    assert seen == [0, 1, 2]


def test_the_window_makes_the_sender_wait(net: Net) -> None:
    a, b, go, sent = net.bus("a"), net.bus("b"), threading.Event(), []
    b.handle(ACKED, lambda m: (go.wait(PATIENCE_S), None)[1])

    def send_all() -> None:
        for number in range(10):
            a.send(ACKED, message(number))
            sent.append(number)

    thread = threading.Thread(target=send_all)
    thread.start()
    wait_until(lambda: len(sent) == ACKED.depth)
    thread.join(0.05)
    assert len(sent) == ACKED.depth
    go.set()
    thread.join(PATIENCE_S)
    a.drain(PATIENCE_S)
    assert len(sent) == 10


def test_messages_are_sent_again_after_the_reader_was_restarted(net: Net) -> None:
    a, first = net.bus("a"), net.bus("b")
    seen: list[int] = []
    hold, reached = threading.Event(), threading.Event()

    def slow(m: Candidates) -> None:
        if m.query_id == 5:
            reached.set()
            hold.wait(PATIENCE_S)
            raise BusClosedError("the node was interrupted")
        seen.append(m.query_id)

    first.handle(ACKED, slow)
    sender = threading.Thread(target=lambda: [a.send(ACKED, message(number)) for number in range(20)])
    sender.start()
    assert reached.wait(PATIENCE_S)
    # The session goes first, as when a process dies: number 5 is in hand and 6 to 8 are waiting.
    first._session.close()  # type: ignore[no-untyped-call]
    hold.set()
    second = net.bus("b")
    second.handle(ACKED, lambda m: seen.append(m.query_id))
    sender.join(PATIENCE_S)
    a.drain(PATIENCE_S)
    assert seen == list(range(20)) and a.resent >= 1
    net._open = [entry for entry in net._open if entry[0] is not first]
    for worker in first._workers:
        worker.close()  # type: ignore[union-attr]


def test_a_message_is_acknowledged_when_what_follows_from_it_is(net: Net) -> None:
    a, b, c, seen = net.bus("a"), net.bus("b"), net.bus("c"), []
    b.handle(ACKED, lambda m: b.send(NEXT, message(m.query_id + 100)))
    a.send(ACKED, message(1))
    wait_until(lambda: b.resent > 0)
    with pytest.raises(TimedOutError):
        a.drain(0.0)
    c.handle(NEXT, lambda m: seen.append(m.query_id))
    a.drain(PATIENCE_S)
    assert seen == [101]


def test_a_refused_message_is_told_once_and_the_next_go_on(net: Net) -> None:
    a, b, seen = net.bus("a"), net.bus("b"), []

    def handle(m: Candidates) -> None:
        seen.append(m.query_id)
        if m.query_id == 1:
            raise SeamarkError("no disk")

    b.handle(ACKED, handle)
    futures = [a.send(ACKED, message(number)) for number in range(4)]
    with pytest.raises(RemoteError, match="no disk"):
        a.drain(PATIENCE_S)
    a.drain(PATIENCE_S)
    assert seen == [0, 1, 2, 3]
    assert [future.exception(PATIENCE_S) is None for future in futures] == [True, False, True, True]


def wait_for_queryable(session: Any, key: str) -> None:
    querier = session.declare_querier(key)
    wait_until(lambda: querier.matching_status.matching)
    querier.undeclare()


def ask_raw(session: Any, key: str, payload: bytes | None, attachment: bytes | None) -> str:
    for reply in session.get(key, payload=payload, attachment=attachment, timeout=PATIENCE_S):
        return "ok" if reply.ok is not None else str(reply.err.payload.to_bytes())
    return "nothing"


def test_readers_refuse_gaps_strangers_and_garbage_and_acknowledge_duplicates(net: Net) -> None:
    a, b, seen = net.bus("a"), net.bus("b"), []
    b.handle(ACKED, lambda m: seen.append(m.query_id))
    key, sender = ACKED.key("x", "b"), a._id
    wait_for_queryable(net.router, key)
    assert "INVALID" in ask_raw(net.router, key, encode(message(0)), None)
    assert "INVALID" in ask_raw(net.router, key, encode(message(0)), b"short")
    assert "GAP" in ask_raw(net.router, key, encode(message(7)), pack_stamp(sender, 7, 6))
    assert ask_raw(net.router, key, encode(message(6)), pack_stamp(sender, 6, 6)) == "ok"
    assert "GAP" in ask_raw(net.router, key, encode(message(8)), pack_stamp(sender, 8, 6))
    assert ask_raw(net.router, key, encode(message(6)), pack_stamp(sender, 6, 6)) == "ok"
    assert "INVALID" in ask_raw(net.router, key, b"\xff\xff", pack_stamp(sender, 7, 7))
    assert "INVALID" in ask_raw(net.router, key, None, pack_stamp(sender, 8, 8))
    assert ask_raw(net.router, key, encode(message(9)), pack_stamp(sender, 9, 9)) == "ok"
    assert seen == [6, 9]


def test_requests_keep_their_order_and_bring_arrays(net: Net) -> None:
    a, b, seen = net.bus("a"), net.bus("b"), []

    def look(frame: Frame) -> Candidates:
        seen.append(frame.index)
        return message(int(frame.image.sum()))

    b.handle(FRAMES, look)
    wait_until(lambda: a.matched(FRAMES))
    image = np.ones((480, 640, 3), np.uint8)
    futures = [a.request_async(FRAMES, Frame(index, 0, image), PATIENCE_S) for index in range(12)]
    assert [future.result(PATIENCE_S).query_id for future in futures] == [image.size] * 12
    assert seen == list(range(12))


def test_request_errors_are_distinct(net: Net) -> None:
    a, b = net.bus("a"), net.bus("b")
    with pytest.raises(UnavailableError, match="nobody serves topic ask"):
        a.request(ASK, message(0))
    release = threading.Event()

    def serve(m: Candidates) -> Done:
        if m.query_id == 0:
            raise SeamarkError("not today")
        if m.query_id == 1:
            raise ZeroDivisionError
        if m.query_id == 2:
            release.wait(PATIENCE_S)
        return Done("b")

    b.handle(ASK, serve, workers=1)
    wait_until(lambda: a.matched(ASK))
    for number, code in enumerate([ErrorCode.FAILED, ErrorCode.INTERNAL]):
        with pytest.raises(RemoteError) as caught:
            a.request(ASK, message(number))
        assert caught.value.code == code
    with pytest.raises(TimedOutError, match=r"in 0\.1 s"):
        a.request(ASK, message(2), timeout_s=0.1)
    release.set()
    wait_until(lambda: isinstance(_result(a.request_async(ASK, message(3))), Done))
    net.close(b)
    with pytest.raises(UnavailableError):
        a.request(ASK, message(3))


def _result(future: "Future[Any]") -> Any:
    return future.exception(PATIENCE_S) or future.result()


def test_a_full_service_is_busy_and_recovers(net: Net) -> None:
    a, b, release = net.bus("a"), net.bus("b"), threading.Event()
    b.handle(ASK, lambda m: Done("b") if release.wait(PATIENCE_S) else Done(""), workers=2)
    wait_until(lambda: a.matched(ASK))
    futures = [a.request_async(ASK, message(number), PATIENCE_S) for number in range(8)]
    refused = [_result(future) for future in futures[3:]]  # two are served and one, the depth, waits
    assert [getattr(error, "code", None) for error in refused] == [ErrorCode.BUSY] * 5
    release.set()
    assert [_result(future) for future in futures[:3]] == [Done("b")] * 3
    wait_until(lambda: isinstance(_result(a.request_async(ASK, message(9), PATIENCE_S)), Done))


@pytest.mark.parametrize("payload", [None, b"", b"\xff" * 1000, encode(message(1))[:-1]])
def test_garbage_is_refused_and_the_service_lives(net: Net, payload: bytes | None) -> None:
    b = net.bus("b")
    b.handle(ASK, lambda m: Done("b"))
    wait_for_queryable(net.router, ASK.key("x"))
    assert "INVALID" in ask_raw(net.router, ASK.key("x"), payload, None)
    assert ask_raw(net.router, ASK.key("x"), encode(message(0)), None) == "ok"


def test_oversize_payloads_are_refused_at_both_ends(net: Net) -> None:
    a, b, seen = net.bus("a"), net.bus("b"), []
    b.handle(PICTURE, lambda m: seen.append(m) or Done("b"))
    wait_until(lambda: a.matched(PICTURE))
    with pytest.raises(SeamarkError, match="larger than"):
        a.request(PICTURE, PlaceQuery(b"0" * MAX_MESSAGE_BYTES))
    # From the router's own session nothing filters: the node's own check refuses it.
    assert "larger than" in ask_raw(net.router, PICTURE.key("x"), b"0" * (MAX_MESSAGE_BYTES + 1), None)
    # From a client the router lets nothing larger pass.
    with open_session("client", connect=[net.endpoint]) as stranger:
        wait_for_queryable(stranger, PICTURE.key("x"))
        too_large = b"0" * (MAX_MESSAGE_BYTES + 100_000)
        assert ask_raw(stranger, PICTURE.key("x"), too_large, None) == "nothing"
    assert seen == [] and a.request(PICTURE, PlaceQuery(b"0")) == Done("b")


def test_streams_give_the_newest_and_count_what_was_missed(net: Net) -> None:
    a, b, seen, hold = net.bus("a"), net.bus("b"), [], threading.Event()

    def slow(m: Candidates) -> None:
        seen.append(m.query_id)
        hold.wait(PATIENCE_S)

    b.subscribe(STREAM, slow)
    wait_until(lambda: a.matched(STREAM))
    a.publish(STREAM, message(0))
    wait_until(lambda: seen == [0])
    for number in range(1, 50):
        a.publish(STREAM, message(number))
    # A request after the stream on the same links has passed it.
    b.handle(ASK, lambda m: Done("b"))
    wait_until(lambda: a.matched(ASK))
    a.request(ASK, message(0))
    hold.set()
    wait_until(lambda: seen[-1] == 49)
    assert len(seen) <= 4 and sum(b.dropped.values()) == 50 - len(seen)


def test_a_failing_subscriber_and_garbage_do_not_end_a_stream(net: Net, caplog: pytest.LogCaptureFixture) -> None:
    a, b, seen = net.bus("a"), net.bus("b"), []

    def fail(m: Candidates) -> None:
        seen.append(m.query_id)
        raise ValueError(m.query_id)

    with caplog.at_level(logging.CRITICAL, "seamark.service.zenoh_bus"):
        b.subscribe(STREAM, fail)
        wait_until(lambda: a.matched(STREAM))

        def refused() -> bool:
            net.router.put(STREAM.key("x"), b"garbage", attachment=pack_stamp(a._id, 0, 0))
            net.router.put(STREAM.key("x"), b"garbage")
            return b.refused.get(STREAM.name, 0) >= 2

        wait_until(refused)  # the router may not know yet who listens
        for number in range(2):
            a.publish(STREAM, message(number))
            wait_until(lambda number=number: seen[-1:] == [number])  # type: ignore[misc]
    assert a.refused == {}


def test_closing_releases_a_waiting_sender_and_settles_everything(net: Net) -> None:
    a = net.bus("a")
    futures = [a.send(ACKED, message(number)) for number in range(ACKED.depth)]
    errors: list[Exception] = []

    def one_more() -> None:
        try:
            a.send(ACKED, message(99))
        except BusClosedError as error:
            errors.append(error)

    thread = threading.Thread(target=one_more)
    thread.start()
    net.close(a)
    thread.join(PATIENCE_S)
    assert len(errors) == 1
    assert all(isinstance(future.exception(0), BusClosedError) for future in futures)
    with pytest.raises(BusClosedError):
        a.request(ASK, message(0))


def test_closing_ends_a_handler_that_waits_for_a_reply_or_for_its_own_messages(net: Net) -> None:
    a, b, hold = net.bus("a"), net.bus("b"), threading.Event()
    ended: list[str] = []

    def wait_for_ever(m: Candidates) -> Done:
        try:
            if m.query_id == 0:
                b.send(NEXT, message(0))
                b.drain()
            else:
                b.request(LOOP_BACK, message(0), PATIENCE_S)
        except BusClosedError:
            ended.append("closed")
            raise
        return Done("b")

    a.handle(LOOP_BACK, lambda m: (hold.wait(PATIENCE_S), Done("a"))[1])
    b.handle(ASK, wait_for_ever, workers=2)
    wait_until(lambda: a.matched(ASK) and b.matched(LOOP_BACK))
    futures = [a.request_async(ASK, message(number), PATIENCE_S) for number in range(2)]
    wait_until(lambda: b.resent > 0 and len(b._pending) == 1)
    net.close(b)
    hold.set()
    assert ended == ["closed"] * 2
    assert [type(future.exception(PATIENCE_S)) for future in futures] == [UnavailableError] * 2


def test_a_node_that_dies_takes_its_requests_with_it(net: Net) -> None:
    a, b, asked, hold, seen = net.bus("a"), net.bus("b"), threading.Event(), threading.Event(), []
    token = announce(b._session, "x", "b")
    watch = Watch(net.router, "x")
    watch.wait_for(["b"], PATIENCE_S)
    wait_until(lambda: a._watch.alive == {"b"})
    b.handle(ASK, lambda m: (asked.set(), hold.wait(PATIENCE_S), Done("b"))[2])
    b.handle(ACKED, lambda m: (seen.append(m.query_id), None)[1])
    wait_until(lambda: a.matched(ASK))
    future = a.request_async(ASK, message(0), PATIENCE_S)
    assert asked.wait(PATIENCE_S)  # nothing that comes later is handled now
    a.send(ACKED, message(0))
    wait_until(lambda: [outbox._in_flight for outbox in a._outboxes.values()] == [1])
    token.undeclare()  # the queries themselves stay open, as when their end was lost
    assert isinstance(future.exception(PATIENCE_S / 2), UnavailableError)
    wait_until(lambda: a.resent >= 1)
    hold.set()
    a.drain(PATIENCE_S)
    assert seen == [0]
    watch.close()


def test_the_watch_sees_nodes_come_and_go(net: Net) -> None:
    changes: list[tuple[str, bool]] = []
    watch = Watch(net.router, "x", lambda node, came: changes.append((node, came)))
    session = open_session("client", connect=[net.endpoint])
    token = announce(session, "x", "vocab")
    watch.wait_for(["vocab"], PATIENCE_S)
    assert watch.alive == {"vocab"}
    with pytest.raises(TimedOutError, match="backend not alive after 0 s"):
        watch.wait_for(["vocab", "backend"], 0)
    late = Watch(net.router, "x")
    late.wait_for(["vocab"], PATIENCE_S)
    token.undeclare()
    session.close()
    watch.wait_for(["vocab"], PATIENCE_S, alive=False)
    assert changes == [("vocab", True), ("vocab", False)]
    watch.close()
    late.close()


def test_sessions_that_cannot_be_opened_say_where() -> None:
    endpoint = free_endpoint()
    with pytest.raises(SessionError, match=endpoint):
        open_session("client", connect=[endpoint], timeout_s=0.1)
    with (
        open_session("router", listen=[endpoint]),
        pytest.raises(SessionError, match="router at " + endpoint),
    ):
        open_session("router", listen=[endpoint])
    with pytest.raises(SessionError, match="tcpx"):
        open_session("router", listen=["tcpx/127.0.0.1:1"])
    with pytest.raises(zenoh.ZError):
        zenoh.KeyExpr("a//b")
