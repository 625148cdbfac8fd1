"""SIGTERM and SIGINT as something to wait for.

Python runs a handler in the main thread once that comes back from what it waits in, and a signal that comes just before
the wait, or to another thread, does not end it. The interpreter itself therefore writes a byte to a pipe. A
``threading.Event`` would not do: its lock may be taken by the very thread that the handler interrupts.
"""

import os
import select
import signal
from collections.abc import Callable
from typing import TypeVar

Made = TypeVar("Made")


class StopSignalError(BaseException):
    """The order to stop came in the midst of something that is given up for it; no handler of errors holds it up."""


class StopSignal:
    """The order to stop, by SIGTERM or SIGINT, from its making on; to be made and waited for in the main thread."""

    def __init__(self) -> None:
        self.ordered = False
        self._interrupting = False
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the order; return whether it has come."""
        if not self.ordered:
            select.select([self._reader], [], [], timeout_s)
        return self.ordered

    def interrupting(self, make: Callable[[], Made]) -> Made:
        """Return what ``make`` makes; raises StopSignalError where the order comes, or came, before it is there."""
        self._interrupting = True
        try:
            if self.ordered:
                raise StopSignalError
            return make()
        finally:
            self._interrupting = False

    def _on_signal(self, *_: object) -> None:
        self.ordered = True
        if self._interrupting:
            self._interrupting = False  # the next signal must not disturb the tidying up
            raise StopSignalError
