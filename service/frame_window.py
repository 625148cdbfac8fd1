"""Frames on their way to nodes that may die and be started again, and other questions to such nodes."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any, TypeVar

from seamark.frontend.types import Frame, Odometry, Outcome, Quality
from seamark.service import topics
from seamark.service.bus import Bus, UnavailableError
from seamark.service.launcher import Launcher
from seamark.service.local_nodes import LocalNodes
from seamark.service.requests import Empty
from seamark.service.sources.base import Unreadable

CHECK_EVERY_S = 0.5

Nodes = Launcher | LocalNodes
Reply = TypeVar("Reply")


def answer(nodes: Nodes, future: "Future[Reply]") -> Reply:
    """Return a reply; raises NodeFailedError as soon as any node has died for good, for others may wait for it."""
    while True:
        try:
            return future.result(CHECK_EVERY_S)
        except TimeoutError:
            nodes.check()


def ask(nodes: Nodes, topic: topics.Topic, timeout_s: float | None = None) -> Any:
    """Return the reply to an empty request, asking again when the node has died and was started again."""
    while True:
        try:
            return answer(nodes, nodes.bus.request_async(topic, Empty(), timeout_s))
        except UnavailableError:
            nodes.check()
            nodes.wait_until_alive()


class FrameWindow:
    """Frames on their way: at most ``size`` unacknowledged, answered in order, sent again when the front end died."""

    def __init__(self, nodes: Nodes, size: int) -> None:
        self._nodes, self._size = nodes, size
        self._pending: deque[tuple[Frame | Unreadable, Future[Odometry] | None]] = deque()

    def push(self, frame: Frame | Unreadable) -> Iterator[tuple[Frame | Unreadable, Odometry]]:
        """Send a frame and yield those that had to be answered first."""
        while len(self._pending) >= self._size:
            yield self._pop()
        self._pending.append((frame, self._send(frame)))

    def drain(self) -> Iterator[tuple[Frame | Unreadable, Odometry]]:
        """Yield the rest."""
        while self._pending:
            yield self._pop()

    def _send(self, frame: Frame | Unreadable) -> "Future[Odometry] | None":
        if isinstance(frame, Unreadable):
            return None
        bus: Bus = self._nodes.bus
        future = bus.request_async(topics.FRAME, frame)
        if isinstance(self._nodes, LocalNodes):
            self._nodes.bus.pump()
        return future

    def _pop(self) -> tuple[Frame | Unreadable, Odometry]:
        while True:
            frame, future = self._pending[0]
            if future is None:
                assert isinstance(frame, Unreadable)
                odometry = Odometry(frame.index, frame.stamp_ns, frame.file, -1, Quality.LOST, Outcome.UNREADABLE)
                break
            try:
                odometry = answer(self._nodes, future)
                break
            except UnavailableError:
                self._nodes.check()
                self._nodes.wait_until_alive()
                self._pending = deque((waiting, self._send(waiting)) for waiting, _ in self._pending)
        self._pending.popleft()
        return frame, odometry
