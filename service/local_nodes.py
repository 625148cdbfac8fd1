"""The three nodes in one process and one thread, for tests and for runs that are the same to the bit."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil

from seamark.service import topics
from seamark.service.bus import Bus, LocalBus
from seamark.service.nodes import backend_node, frontend_node, vocab_node
from seamark.service.nodes.process import Node
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty
from seamark.service.topics import BACKEND, NODES, RUNNER
from seamark.service.types import ProcessUsage

BUILDERS: dict[str, Callable[[Bus, NodeSettings], Node]] = {
    "frontend": frontend_node.build,
    "vocab": vocab_node.build,
    "backend": backend_node.build,
}


class LocalNodes:
    """What :class:`seamark.service.launcher.Launcher` is, without processes; a context manager."""

    def __init__(self, settings: NodeSettings) -> None:
        map_exists = settings.map_path is not None and settings.map_path.exists()
        self._settings = replace(settings, restore=map_exists)
        self._nodes: dict[str, Node] = {}
        self.bus = LocalBus(RUNNER)
        self.restarts = dict.fromkeys(NODES, 0)

    def __enter__(self) -> Self:
        try:
            settings = self._settings
            for name in reversed(NODES):  # readers first
                self._nodes[name] = BUILDERS[name](self.bus.for_node(name), settings)
                if name == BACKEND and settings.restore:
                    counters = self.bus.request(topics.PROGRESS[BACKEND], Empty()).counters
                    first = counters.get("next_keyframe_id", 0), counters.get("next_session", 0)
                    settings = replace(settings, first_keyframe_id=first[0], first_session=first[1])
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def check(self) -> None:
        """Nothing here can die on its own."""

    def wait_until_alive(self, timeout_s: float = 0.0) -> None:
        """Nothing here can be waited for."""

    def stop(self, gently: bool = True) -> tuple[ProcessUsage, ...]:
        """Stop the nodes in order and return what this process has used."""
        for name in NODES:
            if gently and name in self._nodes:
                self._nodes[name].stop()
        self._close()
        return ()

    def _close(self) -> None:
        for name in NODES:
            node = self._nodes.pop(name, None)
            if node is not None:
                node.close()


def own_usage() -> ProcessUsage:
    """Return what this process has used so far."""
    process = psutil.Process(os.getpid())
    times = process.cpu_times()
    with Path("/proc/self/status").open(encoding="ascii") as status:
        peak = next((int(line.split()[1]) for line in status if line.startswith("VmHWM")), 0)
    return ProcessUsage(RUNNER, 1024 * peak, times.user + times.system)


__all__ = ["LocalNodes", "own_usage"]
