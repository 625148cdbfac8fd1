"""The process of one node: settings come in on standard input, and it lives until it is told to stop.

The parent keeps standard input open. Its end means that the parent has gone, and the node stops too: no orphan is left
even when the parent was killed.
"""

import logging
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import BinaryIO, Protocol

import cv2

from seamark import SeamarkError
from seamark.service.bus import Bus
from seamark.service.nodes.settings import NodeSettings
from seamark.service.stop_signal import StopSignal, StopSignalError
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import announce, open_session

EXIT_FAILED = 1
ORPHAN_PATIENCE_S = 30.0
EXIT_BUG = 70  # sysexits.h: internal software error


class Node(Protocol):
    """What every node can do besides answering."""

    def stop(self) -> None:
        """Finish what was begun and wait until it is acknowledged."""
        ...

    def close(self) -> None:
        """Let go of everything."""
        ...


def write_settings(stream: BinaryIO, settings: NodeSettings) -> None:
    """Write settings as a node's process reads them."""
    data = pickle.dumps(settings)
    stream.write(len(data).to_bytes(8, "little") + data)
    stream.flush()


def read_settings(stream: BinaryIO) -> NodeSettings:
    """Read settings from the parent process, which is trusted."""
    settings = pickle.loads(stream.read(int.from_bytes(stream.read(8), "little")))
    assert isinstance(settings, NodeSettings)
    return settings


def run_process(name: str, build: Callable[[Bus, NodeSettings], Node]) -> int:
    """Run a node until SIGTERM, SIGINT or the end of standard input; returns the exit code.

    An error at the start is one sentence on standard output, for the parent to show. ``build`` may take its time, as
    with a map of which every place is to be described: it is interrupted.
    """
    stop = StopSignal()
    settings = read_settings(sys.stdin.buffer)
    logging.basicConfig(level=settings.log_level, format=f"%(asctime)s {name} %(levelname)s %(name)s: %(message)s")
    cv2.setNumThreads(1)
    threading.Thread(target=_follow_parent, name="parent", daemon=True).start()
    try:
        _live(name, build, settings, stop)
    except StopSignalError:
        logging.getLogger(__name__).debug("stopped while the %s node was being made", name)
    except SeamarkError as error:
        sys.stdout.write(f"{error}\n")
        return EXIT_FAILED
    except Exception as error:
        logging.getLogger(__name__).exception("the %s node has failed", name)
        sys.stdout.write(f"{type(error).__name__}: {error}\n")
        return EXIT_BUG
    return 0


def _live(name: str, build: Callable[[Bus, NodeSettings], Node], settings: NodeSettings, stop: StopSignal) -> None:
    with open_session("client", connect=[settings.endpoint]) as session:
        bus = ZenohBus(session, name, settings.namespace)
        try:
            node = stop.interrupting(lambda: build(bus, settings))
            try:
                token = announce(session, settings.namespace, name)
                stop.wait()
                token.undeclare()
                node.stop()
            finally:
                bus.close()  # no callback runs from here on
                node.close()
        finally:
            bus.close()


def _follow_parent() -> None:
    # Unbuffered: a thread that waits in a buffered read holds a lock which the interpreter's end would stumble over.
    with open(0, "rb", buffering=0, closefd=False) as stream:
        while stream.read(1024):
            pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(ORPHAN_PATIENCE_S)
    os._exit(EXIT_FAILED)  # it waits for acknowledgements of nodes that have gone too
