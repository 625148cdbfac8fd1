"""What a node counts and measures about itself."""

import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import psutil

from seamark.service.requests import Status

# Latencies kept per stage; beyond them the oldest are forgotten, so that a node may run for months.
MAX_LATENCIES = 100_000


class Meter:
    """Counters and latencies of one node; all threads of the node may use it."""

    def __init__(self, node: str) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._counters: dict[str, int] = {}
        self._stages_ms: dict[str, deque[float]] = {}

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter."""
        with self._lock:
            self._counters[name] = self._counters.get(name, 0) + by

    def keep(self, name: str, value: int) -> None:
        """Set a counter that does not add up."""
        with self._lock:
            self._counters[name] = value

    def keep_refused(self, by_topic: Mapping[str, int]) -> None:
        """Set how many messages of each topic were refused."""
        for topic, count in by_topic.items():
            self.keep(f"{topic}_refused", count)

    def add(self, stages_ms: Mapping[str, float]) -> None:
        """Note one latency in ms per stage."""
        with self._lock:
            for stage, ms in stages_ms.items():
                self._stages_ms.setdefault(stage, deque(maxlen=MAX_LATENCIES)).append(ms)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Note how long the block takes."""
        start = time.perf_counter()
        yield
        self.add({stage: 1e3 * (time.perf_counter() - start)})

    def status(self) -> Status:
        """Return everything counted and measured, and what the process has used."""
        with self._lock:
            counters = dict(self._counters)
            stages_ms = {stage: list(values) for stage, values in self._stages_ms.items()}
        rss_bytes, peak_rss_bytes, cpu_s = usage_of(os.getpid())
        return Status(self._node, os.getpid(), rss_bytes, peak_rss_bytes, cpu_s, counters, stages_ms)


def usage_of(process_id: int) -> tuple[int, int, float]:
    """Return RSS, peak RSS in bytes and CPU seconds of a process, with its largest child and all children's time."""
    process = psutil.Process(process_id)
    times = process.cpu_times()
    cpu_s = times.user + times.system + times.children_user + times.children_system
    child_rss, child_peak = 0, 0
    for child in process.children(recursive=True):
        try:
            rss, used = child.memory_info().rss, child.cpu_times()
        except psutil.Error:  # it has just ended
            continue
        child_rss, child_peak = max(child_rss, rss), max(child_peak, _peak_rss(child.pid) or rss)
        cpu_s += used.user + used.system
    rss = process.memory_info().rss
    return rss + child_rss, max(_peak_rss(process.pid), rss) + child_peak, cpu_s


def _peak_rss(pid: int) -> int:
    """Return the largest RSS of a process so far in bytes, 0 where the system does not tell."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)
