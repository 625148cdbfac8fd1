"""A small node for test_zenoh_kill.py: writes down the number of every message before it acknowledges it."""

import sys
from pathlib import Path

from seamark.service.topics import Kind, Topic
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import announce, open_session
from seamark.vocab.types import Candidates

TOPIC = Topic("echo", "echo", Kind.ACKED, Candidates, "writer", ("echo",), 8, "For this test.")


def main(endpoint: str, namespace: str, log: str) -> None:
    with open_session("client", connect=[endpoint]) as session, Path(log).open("a", encoding="utf-8") as lines:

        def write_down(message: Candidates) -> None:
            lines.write(f"{message.query_id}\n")
            lines.flush()

        bus = ZenohBus(session, "echo", namespace)
        bus.handle(TOPIC, write_down)
        token = announce(session, namespace, "echo")
        sys.stdin.read()  # until the test closes it
        bus.close()
        token.undeclare()


if __name__ == "__main__":
    main(*sys.argv[1:])
