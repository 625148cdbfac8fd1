"""A node without a room for test_launcher.py: ``fake_node.py NAME BEHAVIOUR``."""

import os
import sys
import time
from pathlib import Path

from seamark import SeamarkError
from seamark.frontend.types import Frame, Odometry, Outcome, Quality
from seamark.service import topics
from seamark.service.bus import Bus
from seamark.service.nodes.process import run_process
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Status


class FakeNode:
    def __init__(self, bus: Bus, settings: NodeSettings) -> None:
        self._bus, self._settings = bus, settings
        bus.handle(topics.STATUS[bus.node], lambda _: self._status())
        if bus.node in topics.PROGRESS:
            bus.handle(topics.PROGRESS[bus.node], lambda _: self._progress())
        if bus.node == topics.FRONTEND:
            bus.handle(topics.FRAME, self._on_frame)

    def stop(self) -> None:
        if self._bus.node == topics.BACKEND and sys.argv[2] == "stubborn":
            time.sleep(600)
        assert self._settings.map_path is not None
        with self._settings.map_path.open("a", encoding="utf-8") as lines:
            lines.write(f"{self._bus.node}\n")

    def close(self) -> None:
        pass

    def _status(self) -> Status:
        counters = {
            "first": self._settings.first_keyframe_id,
            "next_keyframe_id": {"frontend": 0, "vocab": 7, "backend": 6}[self._bus.node],
            "next_session": 2,
            "threads": int(os.environ["OMP_NUM_THREADS"]),
        }
        return Status(self._bus.node, os.getpid(), 0, 0, 0.0, counters)

    def _progress(self) -> Status:
        if self._bus.node == topics.BACKEND and sys.argv[2] == "mute":
            time.sleep(2)
        return self._status()

    def _on_frame(self, frame: Frame) -> Odometry:
        if frame.index == 13:
            os.kill(os.getpid(), 9)
        return Odometry(frame.index, 0, Path(frame.file).name, 0, Quality.GOOD, Outcome.TRACKED)


def build(bus: Bus, settings: NodeSettings) -> FakeNode:
    if bus.node == topics.VOCAB and sys.argv[2] == "ill":
        raise SeamarkError("the vocabulary words.npz is damaged")
    if bus.node == topics.VOCAB and sys.argv[2] == "slow":
        time.sleep(600)
    return FakeNode(bus, settings)


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1], build))
