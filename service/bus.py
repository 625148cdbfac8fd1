"""The bus: how nodes talk, whatever carries the messages; and LocalBus, which carries them inside one thread.

Nodes know topics (:mod:`seamark.service.topics`) and messages, never Zenoh. The same node runs on a LocalBus, where
everything happens in a reproducible order, and on a :class:`seamark.service.zenoh_bus.ZenohBus`.
"""

import heapq
import itertools
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from seamark import SeamarkError
from seamark.service.repeated_errors import RepeatedErrors
from seamark.service.topics import RUNNER, Kind, Topic
from seamark.service.wire import WireError, decode, encode

logger = logging.getLogger(__name__)
bugs = RepeatedErrors(logger)

#: Takes a message; returns the reply of a request. For an acked topic it returns None, or a Future (for example that of
#: its own ``send``): the message is acknowledged when that is done.
Handler = Callable[[Any], Any]

DRAIN_TIMEOUT_S = 600.0


class ErrorCode(StrEnum):
    """What went wrong at the other end."""

    INVALID = "INVALID"  # the message was malformed; sending it again does not help
    FAILED = "FAILED"  # the node could not do it, for a reason that the text gives
    INTERNAL = "INTERNAL"  # a bug; the node's log has the traceback
    BUSY = "BUSY"  # too many requests are waiting; try again later
    GAP = "GAP"  # an earlier message is missing; the bus sends again by itself


class BusError(SeamarkError):
    """Root of the errors of the bus."""


class UnavailableError(BusError):
    """Nobody answered: the node is not there, or it died while it worked."""


class TimedOutError(BusError):
    """The node is there but has not answered in time."""


class BusClosedError(BusError):
    """The bus was closed while the call waited."""


class RemoteError(BusError):
    """The node answered with an error: ``code`` is an :class:`ErrorCode`, ``message`` its words."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


class WrongKindError(BusError):
    """A topic was used in a way that its row in the table does not allow."""


def error_reply(error: BaseException) -> RemoteError:
    """Return what the asker is told of an exception in a handler; bugs are logged here and told without details."""
    if isinstance(error, RemoteError):
        return error
    if isinstance(error, WireError):
        return RemoteError(ErrorCode.INVALID, str(error))
    if isinstance(error, SeamarkError):
        return RemoteError(ErrorCode.FAILED, str(error))
    bugs.log("a handler failed", error)
    return RemoteError(ErrorCode.INTERNAL, f"{type(error).__name__}; see the node's log")


def check_kind(topic: Topic, *kinds: Kind) -> None:
    """Raise WrongKindError unless the topic is of one of the kinds."""
    if topic.kind not in kinds:
        raise WrongKindError(f"topic {topic.name} is {topic.kind}, not {' or '.join(kinds)}")


class Bus(Protocol):
    """One node's access to the topics."""

    @property
    def node(self) -> str:
        """Return the node's name."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """Return how many messages of each subscribed stream were missed, by the topic's name."""
        ...

    @property
    def refused(self) -> Mapping[str, int]:
        """Return how many messages this node has refused for what was in them, by the topic's name."""
        ...

    def send(self, topic: Topic, message: object) -> "Future[None]":
        """Send on an acked topic to every reader; waits while the window is full.

        The Future is done when all readers have acknowledged. Raises WireError, BusClosedError.
        """
        ...

    def wait_for_room(self, topic: Topic, timeout_s: float) -> bool:
        """Return whether the next ``send`` on an acked topic would not wait, waiting for that at most so long."""
        ...

    def publish(self, topic: Topic, message: object) -> None:
        """Publish on a stream; never waits for readers."""
        ...

    def request(self, topic: Topic, message: object, timeout_s: float | None = None) -> Any:
        """Return the reply, in the topic's time unless told otherwise.

        Raises UnavailableError, TimedOutError, RemoteError, WireError or BusClosedError.
        """
        ...

    def request_async(self, topic: Topic, message: object, timeout_s: float | None = None) -> "Future[Any]":
        """Return a Future of the reply, with the errors of :meth:`request`; requests of one thread keep their order."""
        ...

    def handle(self, topic: Topic, callback: Handler, *, workers: int = 0) -> None:
        """Serve an acked or request topic.

        With ``workers`` = 0 the callback runs in the node's one ordered worker, as all others of that kind; else in
        threads of its own. An exception becomes an error reply.
        """
        ...

    def subscribe(self, topic: Topic, callback: Callable[[Any], object]) -> None:
        """Receive a stream; a slow callback sees the newest messages only."""
        ...

    def drain(self, timeout_s: float = DRAIN_TIMEOUT_S) -> None:
        """Wait until everything sent is acknowledged; raises TimedOutError, or the RemoteError of a refused message."""
        ...

    def close(self) -> None:
        """Stop handlers, then sending, then the connection; what is not acknowledged is given up."""
        ...


@dataclass(order=True)
class _Delivery:
    stamp_ns: int
    topic: str
    sequence: int
    run: Callable[[], None] = field(compare=False)


class _Hub:
    """What the LocalBuses of one process share: handlers, subscribers, the queue in (stamp, topic, sequence) order."""

    def __init__(self, through_wire: bool) -> None:
        self.through_wire = through_wire
        self.handlers: dict[tuple[str, str], Handler] = {}
        self.subscribers: dict[str, list[Callable[[Any], object]]] = {}
        self._queue: list[_Delivery] = []
        self._sequence = itertools.count()
        self._now_ns = 0
        self._latest_ns: dict[str, int] = {}
        self._pumping = False

    def carry(self, message: Any, kind: type) -> Any:
        """Return the message as its reader sees it."""
        return decode(encode(message), kind) if self.through_wire else message

    def push(self, topic: Topic, message: object, run: Callable[[], None]) -> None:
        """Queue a delivery; a message without a stamp has that of the message being handled.

        A stamp that runs backward (the next recording of several) never overtakes an earlier message of its topic.
        """
        stamp = getattr(message, "stamp_ns", self._now_ns)
        stamp = self._latest_ns[topic.name] = max(stamp, self._latest_ns.get(topic.name, stamp))
        heapq.heappush(self._queue, _Delivery(stamp, topic.name, next(self._sequence), run))

    def pump(self) -> int:
        """Run deliveries until none is left; returns how many. Inside a handler it leaves them to the outer pump."""
        if self._pumping:
            return 0
        self._pumping, count = True, 0
        try:
            while self._queue:
                delivery = heapq.heappop(self._queue)
                self._now_ns = delivery.stamp_ns
                delivery.run()
                count += 1
        finally:
            self._pumping = False
        return count


class LocalBus:
    """A Bus inside one thread: nothing runs until :meth:`pump`, then in (stamp, topic, sequence) order.

    ``for_node`` gives the other nodes theirs. A request is a plain call. With ``through_wire`` every message is encoded
    and decoded as Zenoh would carry it.
    """

    def __init__(self, node: str = RUNNER, *, through_wire: bool = True, _hub: _Hub | None = None) -> None:
        self._node = node
        self._hub = _hub or _Hub(through_wire)

    @property
    def node(self) -> str:
        """Return the node's name."""
        return self._node

    @property
    def dropped(self) -> Mapping[str, int]:
        """Return nothing: here no message is missed."""
        return {}

    @property
    def refused(self) -> Mapping[str, int]:
        """Return nothing: here the sender has the error at once."""
        return {}

    def for_node(self, node: str) -> "LocalBus":
        """Return the bus of another node in this process."""
        return LocalBus(node, _hub=self._hub)

    def send(self, topic: Topic, message: object) -> "Future[None]":
        """Queue the message for every reader; the Future is done when all have handled it."""
        check_kind(topic, Kind.ACKED)
        done: Future[None] = Future()
        waiting = set(topic.readers)

        def deliver(reader: str, received: object) -> None:
            self._call(topic, reader, received)
            waiting.discard(reader)
            if not waiting:
                done.set_result(None)

        for reader in topic.readers:
            received = self._hub.carry(message, topic.message)
            self._hub.push(topic, message, lambda reader=reader, received=received: deliver(reader, received))  # type: ignore[misc]
        return done

    def wait_for_room(self, topic: Topic, timeout_s: float) -> bool:
        """Return True: here nobody waits."""
        return True

    def publish(self, topic: Topic, message: object) -> None:
        """Queue the message for every subscriber."""
        check_kind(topic, Kind.STREAM)
        for callback in self._hub.subscribers.get(topic.name, []):
            received = self._hub.carry(message, topic.message)
            self._hub.push(topic, message, lambda callback=callback, received=received: callback(received))  # type: ignore[misc]

    def request(self, topic: Topic, message: object, timeout_s: float | None = None) -> Any:
        """Call the handler now and return its reply."""
        check_kind(topic, Kind.REQUEST)
        assert topic.reply is not None
        reply = self._call(topic, topic.readers[0], self._hub.carry(message, topic.message))
        return self._hub.carry(reply, topic.reply)

    def request_async(self, topic: Topic, message: object, timeout_s: float | None = None) -> "Future[Any]":
        """Call the handler now; the Future is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(self.request(topic, message, timeout_s))
        except BusError as error:
            future.set_exception(error)
        return future

    def handle(self, topic: Topic, callback: Handler, *, workers: int = 0) -> None:
        """Serve a topic; ``workers`` means nothing here."""
        check_kind(topic, Kind.ACKED, Kind.REQUEST)
        if self._node not in topic.readers:
            raise WrongKindError(f"{self._node} is not a reader of topic {topic.name}")
        self._hub.handlers[topic.name, self._node] = callback

    def subscribe(self, topic: Topic, callback: Callable[[Any], object]) -> None:
        """Receive every message of a stream."""
        check_kind(topic, Kind.STREAM)
        self._hub.subscribers.setdefault(topic.name, []).append(callback)

    def pump(self) -> int:
        """Deliver everything queued, also what is queued meanwhile; returns how many deliveries that were."""
        return self._hub.pump()

    def drain(self, timeout_s: float = DRAIN_TIMEOUT_S) -> None:
        """Deliver everything queued; raises the RemoteError of a handler that failed."""
        self.pump()

    def close(self) -> None:
        """Forget this node's handlers."""
        for name, node in list(self._hub.handlers):
            if node == self._node:
                del self._hub.handlers[name, node]

    def _call(self, topic: Topic, reader: str, message: object) -> Any:
        callback = self._hub.handlers.get((topic.name, reader))
        if callback is None:
            raise UnavailableError(f"nobody serves topic {topic.name} as {reader}")
        try:
            return callback(message)
        except Exception as error:
            raise error_reply(error) from error
