"""One process of a node: started with its settings, signalled while it lives, and booked when it has ended."""

import contextlib
import logging
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence

import psutil

from seamark.service.nodes.meter import usage_of
from seamark.service.nodes.process import write_settings
from seamark.service.nodes.settings import NodeSettings

logger = logging.getLogger(__name__)

# One thread per process and library: OpenCV, BLAS and OpenMP would otherwise fight for the same cores.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class NodeProcess:
    """A running node and the thread that waits for its end, which calls ``on_end`` with it; raises OSError.

    When it has ended ``exit_code`` is set, ``last_word`` is the last line that it wrote to standard output, and
    ``peak_rss_bytes`` and ``cpu_s`` are what it has used.
    """

    def __init__(
        self, name: str, command: Sequence[str], settings: NodeSettings, on_end: Callable[["NodeProcess"], None]
    ) -> None:
        self.name = name
        self.ended = threading.Event()
        self.exit_code: int | None = None
        self.last_word = ""
        self.peak_rss_bytes = 0
        self.cpu_s = 0.0
        self._lock = threading.Lock()  # held while the process id is used, and while the process is reaped
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | dict.fromkeys(THREAD_VARIABLES, "1"),
            start_new_session=True,  # Ctrl-C is for the parent, which stops the nodes in order
        )
        threading.Thread(target=self._follow, args=(on_end,), name=f"follow-{name}", daemon=True).start()
        assert self._process.stdin is not None
        try:
            write_settings(self._process.stdin, settings)  # type: ignore[arg-type]
        except BrokenPipeError:
            logger.debug("%s ended before it read its settings", name)

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def note_memory(self) -> None:
        """Take down the peak of its memory while it lives.

        The kernel's maximum at the end begins with what this process had when it started the child: an upper bound.
        """
        with contextlib.suppress(psutil.Error):
            self.peak_rss_bytes = usage_of(self.pid)[1]

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, unless the process has ended."""
        with self._lock:
            if not self.ended.is_set():
                os.kill(self.pid, number)

    def _follow(self, on_end: Callable[["NodeProcess"], None]) -> None:
        """Wait for the end of the process and book what it has used."""
        os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
        lines = _what_was_said(self._process).splitlines()
        with self._lock:  # from here on the process id may be another's
            _, status, usage = os.wait4(self.pid, 0)
            self.exit_code = self._process.returncode = os.waitstatus_to_exitcode(status)
            self.last_word = lines[-1] if lines else f"exit code {self.exit_code}"
            self.peak_rss_bytes = self.peak_rss_bytes or 1024 * usage.ru_maxrss
            self.cpu_s = usage.ru_utime + usage.ru_stime
            self.ended.set()
        on_end(self)


def _what_was_said(process: "subprocess.Popen[bytes]") -> str:
    """Return what a process that has ended wrote to standard output, and close its pipes."""
    assert process.stdin is not None and process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    with process.stdout as stdout:
        os.set_blocking(stdout.fileno(), False)  # a grandchild may still hold the other end
        return (stdout.read() or b"").decode(errors="replace").strip()
