"""`seamark feed`: the frames of a source to a running service, none of them lost."""

from collections import Counter, deque
from concurrent.futures import Future

from seamark.frontend.types import Odometry
from seamark.service import topics
from seamark.service.run import Pace, Progress
from seamark.service.sources.base import Source, Unreadable
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import CLIENT_CONNECT_TIMEOUT_S, open_session


def feed(
    source: Source, *, endpoint: str, namespace: str, window: int, realtime: bool, progress: Progress | None = None
) -> dict[str, int]:
    """Send every readable frame and return how often each outcome was answered; raises BusError."""
    outcomes: Counter[str] = Counter()
    pending: deque[Future[Odometry]] = deque()

    def take() -> None:
        odometry = pending.popleft().result()
        outcomes[str(odometry.outcome)] += 1
        if progress is not None:
            progress(outcomes.total(), source.n_frames, odometry)

    with open_session("client", connect=[endpoint], timeout_s=CLIENT_CONNECT_TIMEOUT_S) as session:
        bus = ZenohBus(session, topics.RUNNER, namespace)
        pace = Pace() if realtime else None
        try:
            for frame in source.frames():
                if isinstance(frame, Unreadable):
                    outcomes["unreadable"] += 1
                    continue
                if pace is not None:
                    pace.wait(frame.stamp_ns)
                while len(pending) >= window:
                    take()
                pending.append(bus.request_async(topics.FRAME, frame))
            while pending:
                take()
        finally:
            bus.close()
    return dict(outcomes)
