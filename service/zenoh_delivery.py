"""Acknowledged delivery over Zenoh queries: in order, once, also across a restart of the reader.

The sender numbers its messages and keeps those without acknowledgement. A message is a query; the reply is the
acknowledgement. When a query ends without one (the reader died, refused or was not there) or the reader is BUSY, the
sender goes back to the first unacknowledged message and sends all from there again (go-back-N). The reader handles
number n only after n - 1, acknowledges what it has already handled without handling it again, and refuses gaps. A
reader that has never heard of the sender starts at its ``base``, the lowest number without acknowledgement.
"""

import contextlib
import json
import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any
from uuid import UUID

import zenoh

from seamark.service.bus import BusClosedError, ErrorCode, RemoteError, TimedOutError, error_reply
from seamark.service.wire import MAX_MESSAGE_BYTES, WireError

logger = logging.getLogger(__name__)

ACKNOWLEDGE_TIMEOUT_S = 60.0
BACKOFF_FIRST_S = 0.02
BACKOFF_LAST_S = 1.0
TIMEOUT_PAYLOAD = b"Timeout"
MAX_SENDERS = 256
_STAMP = struct.Struct("<16sQQ")


def pack_stamp(sender: UUID, number: int, base: int) -> bytes:
    """Return the attachment of a message: who sent it, its number, the lowest number without acknowledgement."""
    return _STAMP.pack(sender.bytes, number, base)


def unpack_stamp(attachment: Any) -> tuple[bytes, int, int]:
    """Return sender, number and base of an attachment; raises WireError."""
    data = b"" if attachment is None else attachment.to_bytes()
    if len(data) != _STAMP.size:
        raise WireError(f"a message has an attachment of {len(data)} bytes instead of {_STAMP.size}")
    sender, number, base = _STAMP.unpack(data)
    return sender, number, base


def payload_of(query: Any) -> bytes:
    """Return the bytes of a query or sample; raises WireError when they are too many."""
    payload = query.payload
    size = 0 if payload is None else len(payload)
    if size > MAX_MESSAGE_BYTES:
        raise WireError(f"a message of {size} bytes is larger than {MAX_MESSAGE_BYTES}")
    return b"" if payload is None else bytes(payload.to_bytes())


def answer(query: Any, payload: bytes, encoding: str | None = None) -> None:
    """Reply to a query and end it; a connection that has gone meanwhile does not matter here."""
    with contextlib.suppress(zenoh.ZError), query:
        query.reply(query.key_expr, payload, encoding=encoding)


def refuse(query: Any, error: RemoteError) -> None:
    """Reply with an error to a query and end it."""
    content = json.dumps({"code": str(error.code), "message": error.message}).encode()
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(content, encoding="application/json")


def refusal(payload: bytes) -> RemoteError:
    """Return the error in the payload of an error reply."""
    try:
        content = json.loads(payload)
        return RemoteError(str(content["code"]), str(content["message"]))
    except (ValueError, KeyError, TypeError):
        return RemoteError(ErrorCode.INTERNAL, f"an error reply of {len(payload)} bytes that is not Seamark's")


@dataclass(eq=False)
class _Item:
    number: int
    payload: bytes
    done: "Future[None]" = field(default_factory=Future)
    answered: bool = False
    error: RemoteError | None = None


class Outbox:
    """Sends to one reader of one acked topic; one thread owns all state but the count of what is outstanding."""

    def __init__(self, session: Any, key: str, encoding: str, window: int, sender: UUID) -> None:
        self._session = session
        self._key = key
        self._encoding = encoding
        self._window = window
        self._sender = sender
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._room = threading.Condition()
        self._outstanding = 0
        self._next_number = 0
        self._closed = False
        self._failure: RemoteError | None = None
        self._items: deque[_Item] = deque()
        self._in_flight = 0
        self._generation = 0
        self._backoff_s = BACKOFF_FIRST_S
        self._resume_at = 0.0
        self.resent = 0
        self._thread = threading.Thread(target=self._run, name=f"outbox-{key}", daemon=True)
        self._thread.start()

    def send(self, payload: bytes) -> "Future[None]":
        """Queue a message; waits while the window is full. Raises BusClosedError."""
        with self._room:
            while self._outstanding >= self._window and not self._closed:
                self._room.wait()
            if self._closed:
                raise BusClosedError(f"{self._key} is closed")
            self._outstanding += 1
            item = _Item(self._next_number, payload)
            item.done.set_running_or_notify_cancel()  # nobody can cancel what is on its way
            self._next_number += 1
            self._events.put(lambda: self._items.append(item))
        return item.done

    def wait_for_room(self, deadline: float) -> bool:
        """Wait until the window has room, at most until ``deadline`` (time.monotonic); return whether it has."""
        with self._room:
            return self._room.wait_for(
                lambda: self._outstanding < self._window or self._closed, max(0.0, deadline - time.monotonic())
            )

    def reader_changed(self, came: bool) -> None:
        """Take note that the reader has died, or is there again and need not be waited for any longer."""
        self._events.put(self._on_reader_came if came else self._on_reader_gone)

    def drain(self, deadline: float) -> None:
        """Wait until nothing is outstanding; raises TimedOutError, BusClosedError, or the first refusal."""
        with self._room:
            while self._outstanding and not self._closed:
                if not self._room.wait(max(0.0, deadline - time.monotonic())) and time.monotonic() >= deadline:
                    raise TimedOutError(f"{self._outstanding} messages to {self._key} are not acknowledged")
            if self._outstanding:
                raise BusClosedError(f"{self._key} was closed before {self._outstanding} messages arrived")
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def close(self) -> None:
        """Stop sending; what is outstanding is given up and its Futures get a BusClosedError."""
        with self._room:
            self._closed = True
            self._room.notify_all()
        self._events.put(lambda: None)
        self._thread.join()
        for item in self._items:
            item.done.set_exception(BusClosedError(f"{self._key} was closed before message {item.number} arrived"))
        if self._items:
            logger.warning("%s: %d messages given up", self._key, len(self._items))

    def _run(self) -> None:
        while not self._closed:
            pause = self._resume_at - time.monotonic()
            if pause <= 0:
                self._fill()
            with contextlib.suppress(Empty):
                waiting = self._in_flight < len(self._items)
                self._events.get(timeout=max(pause, 0.001) if waiting else None)()
                while True:
                    self._events.get_nowait()()

    def _fill(self) -> None:
        """Put every queued message on its way."""
        while self._in_flight < len(self._items) and not self._closed:
            item, generation = self._items[self._in_flight], self._generation
            self._in_flight += 1
            try:
                self._query(item, generation)
            except zenoh.ZError as error:
                self._go_back(generation, str(error))
                return

    def _query(self, item: _Item, generation: int) -> None:
        # The callbacks run in Zenoh's network thread, or inside get itself, and must only put something aside.
        self._session.get(
            self._key,
            zenoh.handlers.Callback(
                lambda reply: self._events.put(lambda: self._on_reply(item, generation, reply)),
                drop=lambda: self._events.put(lambda: self._on_end(item, generation)),
                indirect=False,
            ),
            payload=item.payload,
            encoding=self._encoding,
            attachment=pack_stamp(self._sender, item.number, self._items[0].number),
            timeout=ACKNOWLEDGE_TIMEOUT_S,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _on_reply(self, item: _Item, generation: int, reply: Any) -> None:
        if reply.ok is not None:
            self._on_answer(item, None)
            return
        payload = reply.err.payload.to_bytes()
        error = refusal(payload)
        if payload == TIMEOUT_PAYLOAD:
            self._go_back(generation, f"no acknowledgement in {ACKNOWLEDGE_TIMEOUT_S:g} s")
        elif error.code in (ErrorCode.GAP, ErrorCode.BUSY):
            self._go_back(generation, str(error))
        else:
            self._on_answer(item, error)

    def _on_end(self, item: _Item, generation: int) -> None:
        if not item.answered:
            self._go_back(generation, "no reader")

    def _on_reader_gone(self) -> None:
        self._go_back(self._generation, "the reader has died")

    def _on_reader_came(self) -> None:
        self._resume_at = 0.0

    def _on_answer(self, item: _Item, error: RemoteError | None) -> None:
        if item.answered:
            return
        item.answered, item.error = True, error
        self._backoff_s = BACKOFF_FIRST_S
        while self._items and self._items[0].answered:
            self._finish(self._items.popleft())
            self._in_flight = max(0, self._in_flight - 1)

    def _finish(self, item: _Item) -> None:
        if item.error is not None:
            logger.error("%s refused message %d: %s", self._key, item.number, item.error)
        with self._room:
            self._failure = self._failure or item.error
            self._outstanding -= 1
            self._room.notify_all()
        if item.error is not None:
            item.done.set_exception(item.error)
        else:
            item.done.set_result(None)

    def _go_back(self, generation: int, reason: str) -> None:
        """Send everything unacknowledged again, after a pause that doubles until an acknowledgement comes."""
        if generation != self._generation or not self._items:
            return
        level = logging.WARNING if self._backoff_s > BACKOFF_LAST_S / 2 else logging.DEBUG
        logger.log(level, "%s: message %d is sent again: %s", self._key, self._items[0].number, reason)
        self.resent += self._in_flight
        self._generation += 1
        self._in_flight = 0
        self._resume_at = time.monotonic() + self._backoff_s
        self._backoff_s = min(2 * self._backoff_s, BACKOFF_LAST_S)


class Reader:
    """Receives one acked topic, in the order of each sender; ``handle`` takes a payload and may return a Future.

    ``refused`` is told of errors. All calls come from one thread, the node's ordered worker.
    """

    def __init__(
        self,
        name: str,
        handle: Callable[[bytes], "Future[None] | None"],
        refused: Callable[[str, RemoteError], None],
    ) -> None:
        self._name = name
        self._refused = refused
        self._handle = handle
        self._expected: dict[bytes, int] = {}
        self._pending: dict[tuple[bytes, int], Future[None]] = {}

    def process(self, query: Any) -> None:
        """Handle, acknowledge or refuse one query."""
        try:
            sender, number, base = unpack_stamp(query.attachment)
        except WireError as error:
            self._refused(self._name, error_reply(error))
            refuse(query, error_reply(error))
            return
        expected = max(self._expected.get(sender, base), base)
        if number > expected:
            refuse(query, RemoteError(ErrorCode.GAP, f"{self._name}: {number} came before {expected}"))
        elif number < expected:
            self._acknowledge_later(query, self._pending.get((sender, number)))
        else:
            self._advance(sender, number + 1)
            try:
                done = self._handle(payload_of(query))
            except BusClosedError:  # this node is closing: no reply, the sender sends again to the next one
                self._advance(sender, number)
                return
            except Exception as error:
                refusal_of = error_reply(error)
                self._refused(self._name, refusal_of)
                if refusal_of.code == ErrorCode.BUSY:  # not now: the sender keeps it and sends it again
                    self._advance(sender, number)
                refuse(query, refusal_of)
                return
            if done is not None:
                self._pending[sender, number] = done
                done.add_done_callback(lambda _: self._pending.pop((sender, number), None))
            self._acknowledge_later(query, done)

    def _advance(self, sender: bytes, expected: int) -> None:
        # The newest sender is last; the oldest is forgotten, so that strangers cannot fill the memory.
        self._expected.pop(sender, None)
        self._expected[sender] = expected
        if len(self._expected) > MAX_SENDERS:
            del self._expected[next(iter(self._expected))]

    @staticmethod
    def _acknowledge_later(query: Any, done: "Future[None] | None") -> None:
        def acknowledge(future: "Future[None] | None") -> None:
            error = None if future is None else future.exception()
            if error is None:
                answer(query, b"")
            elif not isinstance(error, BusClosedError):  # closing: no reply, the sender sends again
                refuse(query, error_reply(error))

        if done is None:
            acknowledge(None)
        else:
            done.add_done_callback(acknowledge)
