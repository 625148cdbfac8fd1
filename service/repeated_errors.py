"""A log of errors that somebody may cause again and again: a flood of requests must not become one of tracebacks."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

EVERY_S = 60.0
MOST_KINDS = 256  # after so many different errors the oldest is told in full again


@dataclass
class _Kind:
    logged_at: float
    since: int = 0


class RepeatedErrors:
    """Logs an error in full when it first comes, and then, at most every ``every_s``, in one line how often it came.

    Errors are the same when their type and the line that raised them are. May be shared by threads.
    """

    def __init__(
        self, logger: logging.Logger, every_s: float = EVERY_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._logger, self._every_s, self._clock = logger, every_s, clock
        self._lock = threading.Lock()
        self._kinds: dict[tuple[str, str, int], _Kind] = {}

    def log(self, what: str, error: BaseException) -> None:
        """Log that ``what`` has happened because of an error."""
        now, key = self._clock(), _kind_of(error)
        with self._lock:
            kind = self._kinds.get(key)
            if kind is None:
                if len(self._kinds) >= MOST_KINDS:
                    del self._kinds[next(iter(self._kinds))]
                self._kinds[key] = _Kind(now)
                again = 0
            else:
                kind.since += 1
                if now - kind.logged_at < self._every_s:
                    return
                kind.logged_at, again, kind.since = now, kind.since, 0
        if again:
            self._logger.error("%s %d times more: %s: %s", what, again, type(error).__name__, error)
        else:
            self._logger.error("%s", what, exc_info=error)


def _kind_of(error: BaseException) -> tuple[str, str, int]:
    """Return what an error has in common with others like it."""
    traceback = error.__traceback__
    if traceback is None:
        return type(error).__qualname__, "", 0
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    return type(error).__qualname__, traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
