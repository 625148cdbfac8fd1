"""A reader is killed in mid-stream, twice, and nothing is lost and nothing out of order."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from seamark.service.topics import Kind, Topic
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import Watch, free_endpoint, open_session
from seamark.vocab.types import Candidates

TOPIC = Topic("echo", "echo", Kind.ACKED, Candidates, "writer", ("echo",), 8, "For this test.")
MESSAGES = 3000
PATIENCE_S = 60.0


def _wait_for_lines(log: Path, count: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not log.exists() or log.read_bytes().count(b"\n") < count:
        assert time.monotonic() < deadline, "the reader makes no progress"
        time.sleep(0.002)


@pytest.mark.zenoh
def test_a_killed_reader_misses_nothing(tmp_path: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "seen.txt"
    command = [sys.executable, str(Path(__file__).with_name("echo_reader.py")), endpoint, "kill", str(log)]
    with open_session("router", listen=[endpoint]) as router:
        watch = Watch(router, "kill")
        bus = ZenohBus(router, "writer", "kill")
        sender = threading.Thread(target=lambda: [bus.send(TOPIC, Candidates(n, 0, ())) for n in range(MESSAGES)])
        sender.start()
        for goal in (500, 1500):
            with subprocess.Popen(command, stdin=subprocess.PIPE) as reader:
                watch.wait_for(["echo"], PATIENCE_S)
                _wait_for_lines(log, goal)
                reader.kill()
            watch.wait_for(["echo"], PATIENCE_S, alive=False)
        with subprocess.Popen(command, stdin=subprocess.PIPE) as reader:
            sender.join(PATIENCE_S)
            bus.drain(PATIENCE_S)
            reader.communicate(timeout=PATIENCE_S)
            assert reader.returncode == 0
        assert bus.resent >= 2
        bus.close()
        watch.close()
    seen = [int(line) for line in log.read_text(encoding="utf-8").split()]
    # Acknowledgements that were still inside the killed process are lost: at most a window is sent again, in order.
    steps = [n - before for n, before in zip(seen[1:], seen, strict=False)]
    back = [step for step in steps if step != 1]
    assert len(back) <= 2 and all(-TOPIC.depth < step <= 0 for step in back)
    assert seen[0] == 0 and seen[-1] == MESSAGES - 1 and set(seen) == set(range(MESSAGES))
