"""Requests over Zenoh, both ends: bounded serving in threads, replies and errors as values."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any

from seamark.service.bus import (
    BusClosedError,
    BusError,
    ErrorCode,
    Handler,
    RemoteError,
    TimedOutError,
    UnavailableError,
    error_reply,
)
from seamark.service.repeated_errors import RepeatedErrors
from seamark.service.topics import Topic
from seamark.service.wire import WireError, decode, encode, encoding_of
from seamark.service.zenoh_delivery import TIMEOUT_PAYLOAD, answer, payload_of, refusal, refuse

logger = logging.getLogger(__name__)
bugs = RepeatedErrors(logger)

# A router keeps time as well and may end a query a little before the asker's own timer does, without a word: what ends
# after this part of the time without a reply has timed out.
TIMED_OUT_FRACTION = 0.9


class Worker:
    """One thread that runs what is put to it, in order, until closed."""

    def __init__(self, name: str) -> None:
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], None]) -> None:
        """Queue one piece of work."""
        self._work.put(work)

    def close(self) -> None:
        """Finish the work in hand, forget the rest, and end the thread."""
        self._closed = True
        self._work.put(None)
        if self._thread is not threading.current_thread():
            self._thread.join()
        with contextlib.suppress(Empty):
            while True:
                self._work.get_nowait()

    def _run(self) -> None:
        while (work := self._work.get()) is not None and not self._closed:
            try:
                work()
            except Exception as error:
                bugs.log(f"work of {self._thread.name} failed", error)
            del work  # a query that is kept is never ended


def all_done(futures: "list[Future[None]]") -> "Future[None]":
    """Return a Future that is done when all are, with the first error if there is one."""
    if len(futures) == 1:
        return futures[0]
    together, lock, missing = Future[None](), threading.Lock(), len(futures)
    together.set_running_or_notify_cancel()

    def on_done(_: "Future[None]") -> None:
        nonlocal missing
        with lock:
            missing -= 1
            if missing:
                return
        error = next((error for future in futures if (error := future.exception()) is not None), None)
        if error is None:
            together.set_result(None)
        else:
            together.set_exception(error)

    for future in futures:
        future.add_done_callback(on_done)
    return together


def bounded(
    topic: Topic, limit: int, submit: Callable[[Callable[[], None]], object], process: Callable[[Any], None]
) -> Callable[[Any], None]:
    """Return the callback of a queryable: it puts the query aside and refuses it when ``limit`` are waiting."""
    slots = threading.BoundedSemaphore(limit)

    def run(query: Any) -> None:
        try:
            process(query)
        finally:
            slots.release()

    def on_query(query: Any) -> None:
        if not slots.acquire(blocking=False):
            refuse(query, RemoteError(ErrorCode.BUSY, f"{limit} requests on {topic.name} are waiting; try again later"))
            return
        with contextlib.suppress(RuntimeError):  # the pool is closing: no reply, which the asker sees as unavailable
            submit(lambda: run(query))

    return on_query


def server(topic: Topic, callback: Handler, refused: Callable[[str, RemoteError], None]) -> Callable[[Any], None]:
    """Return what answers one query of a request topic and tells ``refused`` of errors."""

    def process(query: Any) -> None:
        try:
            reply = encode(callback(decode(payload_of(query), topic.message)))
        except BusClosedError:
            return
        except Exception as error:
            refusal_of = error_reply(error)
            refused(topic.name, refusal_of)
            refuse(query, refusal_of)
            return
        assert topic.reply is not None
        answer(query, reply, encoding_of(topic.reply))

    return process


@dataclass(frozen=True, eq=False)
class Asked:
    """A request on its way: its Future, and since when (time.monotonic) and for how long it waits, in seconds."""

    topic: Topic
    future: "Future[Any]"
    since_s: float
    patience_s: float

    def on_reply(self, reply: Any) -> None:
        """Settle the Future by a reply or an error reply."""
        if reply.ok is None:
            payload = reply.err.payload.to_bytes()
            settle(self.future, self._timed_out() if payload == TIMEOUT_PAYLOAD else refusal(payload))
            return
        assert self.topic.reply is not None
        try:
            content: object = decode(payload_of(reply.ok), self.topic.reply)
        except WireError as error:
            settle(self.future, error)
        else:
            with contextlib.suppress(InvalidStateError):
                self.future.set_result(content)

    def on_end(self) -> None:
        """Settle the Future of a request that has ended without any reply."""
        if time.monotonic() - self.since_s >= TIMED_OUT_FRACTION * self.patience_s:
            settle(self.future, self._timed_out())
        else:
            name = self.topic.name
            settle(self.future, UnavailableError(f"nobody serves topic {name}, or its node died while it worked"))

    def _timed_out(self) -> TimedOutError:
        return TimedOutError(f"no reply on topic {self.topic.name} in {self.patience_s:g} s")


def settle(future: "Future[Any]", error: BusError | WireError) -> None:
    """End a request with an error, unless it has ended before."""
    with contextlib.suppress(InvalidStateError):
        future.set_exception(error)
