"""Zenoh sessions and who is alive on them. Endpoints are always explicit: nothing is searched for on the network."""

import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import zenoh

from seamark.service.bus import BusError, TimedOutError
from seamark.service.topics import live_key
from seamark.service.wire import MAX_MESSAGE_BYTES

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 7447
CONNECT_TIMEOUT_S = 10.0
# For those who ask a service that should be there already.
CLIENT_CONNECT_TIMEOUT_S = 2.0
# What the router lets pass, also through shared memory; the margin is for keys and attachments.
SIZE_LIMIT_BYTES = MAX_MESSAGE_BYTES + 65536


class SessionError(BusError):
    """A Zenoh session cannot be opened: wrong endpoint, port in use, nobody there."""


def open_session(
    mode: str, listen: Sequence[str] = (), connect: Sequence[str] = (), timeout_s: float = CONNECT_TIMEOUT_S
) -> Any:
    """Open a session with explicit endpoints; ``mode`` is router, peer or client.

    A client tries for ``timeout_s`` to reach its router. Raises SessionError. Close it before the process ends, else
    the threads of its callbacks keep the process alive.
    """
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(timeout_s * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
        # Under heavy load a query in shared memory can be lost until its timeout (Zenoh's issue 2628); puts may be.
        "transport/shared_memory/transport_optimization/messages": ["put"],
    }
    if mode == "router":
        settings["low_pass_filter"] = [
            {
                "flows": ["ingress"],
                "messages": ["put", "query", "reply"],
                "key_exprs": ["seamark/**"],
                "size_limit": SIZE_LIMIT_BYTES,
            }
        ]
    config = zenoh.Config()
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join([*listen, *connect])
        # Zenoh's own words end every clause with the line of its source.
        words = re.sub(r" at /\S+\.rs:\d+\.?", "", str(error))
        raise SessionError(f"cannot open a Zenoh {mode} at {where}: {words}") from error


def free_endpoint() -> str:
    """Return a TCP endpoint on loopback whose port is free at this moment."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return f"tcp/{LOOPBACK}:{probe.getsockname()[1]}"


def who_lives(session: Any, namespace: str) -> list[str]:
    """Return the names of the nodes that are alive now."""
    replies = session.liveliness().get(live_key(namespace, "*"))
    return sorted(str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None)


class Watch:
    """Knows which nodes are alive, by their liveliness tokens.

    ``changed`` is called with a node's name and whether it came; it runs in a thread of Zenoh and must be quick.
    """

    def __init__(self, session: Any, namespace: str, changed: Callable[[str, bool], None] | None = None) -> None:
        self._condition = threading.Condition()
        self._alive: set[str] = set()
        self._changed = changed
        self._subscriber = session.liveliness().declare_subscriber(
            live_key(namespace, "*"), self._on_sample, history=True
        )

    def _on_sample(self, sample: Any) -> None:
        node, came = str(sample.key_expr).rsplit("/", 1)[1], sample.kind == zenoh.SampleKind.PUT
        with self._condition:
            (self._alive.add if came else self._alive.discard)(node)
            self._condition.notify_all()
        if self._changed is not None:
            self._changed(node, came)

    @property
    def alive(self) -> frozenset[str]:
        """Return the names of the nodes that are alive."""
        with self._condition:
            return frozenset(self._alive)

    def wait_for(
        self, nodes: Iterable[str], timeout_s: float, check: Callable[[], None] = lambda: None, alive: bool = True
    ) -> None:
        """Wait until all nodes are alive (or, with ``alive`` False, none of them); raises TimedOutError.

        ``check`` is called about five times a second and may raise to end the wait.
        """
        wanted, deadline = set(nodes), time.monotonic() + timeout_s
        with self._condition:
            while missing := (wanted - self._alive if alive else wanted & self._alive):
                if time.monotonic() >= deadline:
                    state = "alive" if alive else "gone"
                    raise TimedOutError(f"{', '.join(sorted(missing))} not {state} after {timeout_s:g} s")
                self._condition.wait(0.2)
                check()

    def forget(self, node: str) -> None:
        """Take a node for dead before its token has gone."""
        with self._condition:
            self._alive.discard(node)

    def close(self) -> None:
        """Stop watching."""
        self._subscriber.undeclare()


def announce(session: Any, namespace: str, node: str) -> Any:
    """Declare that a node is alive, as long as the returned token is kept and the session lives."""
    return session.liveliness().declare_token(live_key(namespace, node))
