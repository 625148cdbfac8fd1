"""The bus over Zenoh, for nodes in processes of their own."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any
from uuid import uuid4

import zenoh

from seamark.service.bus import (
    DRAIN_TIMEOUT_S,
    BusClosedError,
    ErrorCode,
    Handler,
    RemoteError,
    UnavailableError,
    WrongKindError,
    bugs,
    check_kind,
    error_reply,
)
from seamark.service.topics import Congestion, Kind, Reliability, Topic
from seamark.service.wire import WireError, decode, encode, encoding_of
from seamark.service.zenoh_delivery import Outbox, Reader, pack_stamp, payload_of, unpack_stamp
from seamark.service.zenoh_serving import Asked, Worker, all_done, bounded, server, settle
from seamark.service.zenoh_session import Watch

logger = logging.getLogger(__name__)

CONGESTION = {
    Congestion.BLOCK: zenoh.CongestionControl.BLOCK,
    Congestion.DROP: zenoh.CongestionControl.DROP,
}
RELIABILITY = {
    Reliability.RELIABLE: zenoh.Reliability.RELIABLE,
    Reliability.BEST_EFFORT: zenoh.Reliability.BEST_EFFORT,
}
# A reader refuses acked messages beyond so many windows of waiting ones: more senders than the table knows.
WINDOWS_WAITING = 4


class ZenohBus:
    """A Bus over one Zenoh session, which stays the caller's: close the bus first, then the session."""

    def __init__(self, session: Any, node: str, namespace: str) -> None:
        self._session = session
        self._node = node
        self._namespace = namespace
        self._id = uuid4()
        self._lock = threading.Lock()
        self._outboxes: dict[tuple[str, str], Outbox] = {}
        self._publishers: dict[str, Any] = {}
        self._published: dict[str, int] = {}
        self._queriers: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._workers: list[Worker | ThreadPoolExecutor] = []
        self._ordered: Worker | None = None
        self._replies: Worker | None = None
        self._subscriber_threads: list[threading.Thread] = []
        self._pending: dict[Future[Any], str] = {}  # and who was asked
        self._closed = False
        self._dropped: dict[str, int] = {}
        self._refused: dict[str, int] = {}
        # A query on its way to a node that is just being killed can be lost without an end before its timeout.
        self._watch = Watch(session, namespace, self._on_change)

    @property
    def node(self) -> str:
        """Return the node's name."""
        return self._node

    @property
    def dropped(self) -> Mapping[str, int]:
        """Return how many messages of each subscribed stream were missed, by the topic's name."""
        return dict(self._dropped)

    @property
    def refused(self) -> Mapping[str, int]:
        """Return how many messages this node has refused for what was in them, by the topic's name."""
        return dict(self._refused)

    @property
    def resent(self) -> int:
        """Return how many messages had to be sent again."""
        return sum(outbox.resent for outbox in self._outboxes.values())

    def send(self, topic: Topic, message: object) -> "Future[None]":
        """Send on an acked topic to every reader; see :meth:`seamark.service.bus.Bus.send`."""
        check_kind(topic, Kind.ACKED)
        payload = encode(message)
        return all_done([self._outbox(topic, reader).send(payload) for reader in topic.readers])

    def wait_for_room(self, topic: Topic, timeout_s: float) -> bool:
        """Return whether all readers' windows have room; see :meth:`seamark.service.bus.Bus.wait_for_room`."""
        check_kind(topic, Kind.ACKED)
        deadline = time.monotonic() + timeout_s
        return all(self._outbox(topic, reader).wait_for_room(deadline) for reader in topic.readers)

    def publish(self, topic: Topic, message: object) -> None:
        """Publish on a stream; never waits for readers."""
        check_kind(topic, Kind.STREAM)
        payload = encode(message)
        with self._lock:
            publisher = self._publisher(topic)
            number = self._published[topic.name] = self._published.get(topic.name, -1) + 1
            publisher.put(payload, attachment=pack_stamp(self._id, number, number))

    def request(self, topic: Topic, message: object, timeout_s: float | None = None) -> Any:
        """Return the reply; never call it from a callback of a Future of this bus, which would wait for itself."""
        return self.request_async(topic, message, timeout_s).result()

    def request_async(self, topic: Topic, message: object, timeout_s: float | None = None) -> "Future[Any]":
        """Return a Future of the reply."""
        check_kind(topic, Kind.REQUEST)
        payload, future = encode(message), Future[Any]()
        asked = Asked(topic, future, time.monotonic(), topic.timeout_s if timeout_s is None else timeout_s)
        future.set_running_or_notify_cancel()
        with self._lock:
            self._check_open()
            replies = self._replies = self._replies or Worker(f"{self._node}-replies")
            self._pending[future] = topic.readers[0]
        future.add_done_callback(lambda done: self._pending.pop(done, None))
        try:
            self._session.get(
                topic.key(self._namespace),
                zenoh.handlers.Callback(
                    lambda reply: replies.submit(lambda: asked.on_reply(reply)),
                    drop=lambda: replies.submit(asked.on_end),
                    indirect=False,
                ),
                payload=payload,
                encoding=encoding_of(topic.message),
                timeout=asked.patience_s,
                congestion_control=CONGESTION[topic.congestion],
            )
        except zenoh.ZError as error:
            settle(future, UnavailableError(f"topic {topic.name} cannot be asked: {error}"))
        return future

    def handle(self, topic: Topic, callback: Handler, *, workers: int = 0) -> None:
        """Serve an acked or request topic; see :meth:`seamark.service.bus.Bus.handle`."""
        check_kind(topic, Kind.ACKED, Kind.REQUEST)
        if self._node not in topic.readers:
            raise WrongKindError(f"{self._node} is not a reader of topic {topic.name}")
        acked = topic.kind is Kind.ACKED
        process: Callable[[Any], None]
        if acked:
            reader = Reader(topic.name, lambda payload: callback(decode(payload, topic.message)), self._count_refused)
            process, limit = reader.process, WINDOWS_WAITING * topic.depth
        else:
            process, limit = server(topic, callback, self._count_refused), topic.depth + max(1, workers)
        with self._lock:
            self._check_open()
            submit = self._pool(topic, workers) if workers and not acked else self._ordered_worker().submit
        self._declared.append(
            self._session.declare_queryable(
                topic.key(self._namespace, self._node if acked else None),
                bounded(topic, limit, submit, process),
                complete=True,
            )
        )

    def subscribe(self, topic: Topic, callback: Callable[[Any], object]) -> None:
        """Receive a stream in a thread of its own; ``dropped`` counts what was lost on the way."""
        check_kind(topic, Kind.STREAM)
        self._check_open()
        subscriber = self._session.declare_subscriber(
            topic.key(self._namespace), zenoh.handlers.RingChannel(topic.depth)
        )
        thread = threading.Thread(
            target=self._receive, args=(topic, subscriber, callback), name=f"{self._node}-{topic.name}", daemon=True
        )
        self._declared.append(subscriber)
        self._subscriber_threads.append(thread)
        thread.start()

    def matched(self, topic: Topic) -> bool:
        """Return whether a stream has a subscriber, or a request topic somebody who answers."""
        check_kind(topic, Kind.STREAM, Kind.REQUEST)
        with self._lock:
            if topic.kind is Kind.STREAM:
                return bool(self._publisher(topic).matching_status.matching)
            if topic.name not in self._queriers:
                self._queriers[topic.name] = self._session.declare_querier(topic.key(self._namespace))
            return bool(self._queriers[topic.name].matching_status.matching)

    def drain(self, timeout_s: float = DRAIN_TIMEOUT_S) -> None:
        """Wait until everything sent is acknowledged; see :meth:`seamark.service.bus.Bus.drain`."""
        deadline = time.monotonic() + timeout_s
        for outbox in list(self._outboxes.values()):
            outbox.drain(deadline)

    def close(self) -> None:
        """Stop handlers, sending and replies, in that order; the session stays open."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._watch.close()
        for declared in self._declared:
            declared.undeclare()
        for outbox in self._outboxes.values():  # before the workers, which may be waiting for room in a window
            outbox.close()
        for future in list(self._pending):
            settle(future, BusClosedError(f"the bus of {self._node} was closed before the reply came"))
        for worker in self._workers:
            if isinstance(worker, ThreadPoolExecutor):
                worker.shutdown(cancel_futures=True)
            else:
                worker.close()
        for thread in self._subscriber_threads:
            if thread is not threading.current_thread():
                thread.join()
        for declared in (*self._publishers.values(), *self._queriers.values()):
            declared.undeclare()
        if self._replies is not None:
            self._replies.close()

    def _on_change(self, node: str, came: bool) -> None:
        """End requests that a node took with it when it died, and send again what it has not acknowledged."""
        for (_, reader), outbox in list(self._outboxes.items()):
            if reader == node:
                outbox.reader_changed(came)
        for future, asked in list(self._pending.items()):
            if asked == node and not came:
                settle(future, UnavailableError(f"the {node} node died while it worked"))

    def _count_refused(self, topic: str, error: RemoteError) -> None:
        """Count what was refused, and say so: once for each doubling, so that a flood does not fill the log."""
        if error.code in (ErrorCode.BUSY, ErrorCode.GAP):  # nothing is wrong with the message
            return
        with self._lock:
            count = self._refused[topic] = self._refused.get(topic, 0) + 1
        if count & (count - 1) == 0:
            logger.warning("message %d that was refused on topic %s: %s", count, topic, error)

    def _check_open(self) -> None:
        if self._closed:
            raise BusClosedError(f"the bus of {self._node} is closed")

    def _outbox(self, topic: Topic, reader: str) -> Outbox:
        with self._lock:
            self._check_open()
            outbox = self._outboxes.get((topic.name, reader))
            if outbox is None:
                key = topic.key(self._namespace, reader)
                outbox = Outbox(self._session, key, encoding_of(topic.message), topic.depth, self._id)
                self._outboxes[topic.name, reader] = outbox
            return outbox

    def _publisher(self, topic: Topic) -> Any:
        self._check_open()
        if topic.name not in self._publishers:
            self._publishers[topic.name] = self._session.declare_publisher(
                topic.key(self._namespace),
                encoding=encoding_of(topic.message),
                congestion_control=CONGESTION[topic.congestion],
                reliability=RELIABILITY[topic.reliability],
            )
        return self._publishers[topic.name]

    def _ordered_worker(self) -> Worker:
        if self._ordered is None:
            self._ordered = Worker(f"{self._node}-worker")
            self._workers.append(self._ordered)
        return self._ordered

    def _pool(self, topic: Topic, workers: int) -> Callable[[Callable[[], None]], object]:
        pool = ThreadPoolExecutor(workers, thread_name_prefix=f"{self._node}-{topic.name}")
        self._workers.append(pool)
        return pool.submit

    def _receive(self, topic: Topic, subscriber: Any, callback: Callable[[Any], object]) -> None:
        latest: dict[bytes, int] = {}
        for sample in subscriber:
            try:
                sender, number, _ = unpack_stamp(sample.attachment)
                missed = number - latest.get(sender, number - 1) - 1
                latest = {sender: number} if len(latest) > 64 else latest | {sender: number}
                self._dropped[topic.name] = self._dropped.get(topic.name, 0) + max(0, missed)
                callback(decode(payload_of(sample), topic.message))
            except WireError as error:
                self._count_refused(topic.name, error_reply(error))
            except BusClosedError:
                return
            except Exception as error:
                bugs.log(f"a subscriber of {topic.name} failed", error)
