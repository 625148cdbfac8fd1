"""Starts the three nodes as processes, restarts those that die, and stops them in order."""

import contextlib
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

from seamark.service.bus import BusError
from seamark.service.node_process import NodeProcess
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, Status
from seamark.service.topics import BACKEND, FRONTEND, KEYFRAME, NODES, PROGRESS, RUNNER, STOPPING, VOCAB
from seamark.service.types import ProcessUsage
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import SessionError, Watch, free_endpoint, open_session, who_lives

logger = logging.getLogger(__name__)

START_TIMEOUT_S = 60.0
RESTORE_TIMEOUT_S = 1800.0  # a large map without a place index beside it is described anew; who dies is noticed
PROGRESS_TIMEOUT_S = RESTORE_TIMEOUT_S  # of a node that lives and does not say how far it is: it may open a large map
STOP_TIMEOUT_S = 4.0  # for all nodes together: 5 s with what is around it, on a busy machine
# Until when each node may take its time, so that those behind it have theirs; what has not ended then is killed.
STOP_SHARES = {FRONTEND: 0.45, VOCAB: 0.75, BACKEND: 1.0}
CLOSE_TIMEOUT_S = 0.5  # for the bus and the session of this process, once no node is left
KILL_TIMEOUT_S = 1.0  # until a killed process is gone
MAX_RESTARTS = 3  # of one node within RESTARTS_WITHIN_S: a crash now and then in months is none too many
RESTARTS_WITHIN_S = 600.0
PROGRESS_EVERY_S = 0.1
# More keyframes than a front end can have announced without having handed them over.
LOST_KEYFRAMES = 4 * KEYFRAME.depth


class NodeFailedError(BusError):
    """A node could not start, or died more often than it may be restarted; the text is its own last word."""


class StartInterruptedError(BusError):
    """The service was told to stop before its nodes were alive."""


class Launcher:
    """The three node processes and the session that connects them; a context manager.

    Without ``settings.endpoint`` a Zenoh router runs in this process, on a free port of loopback or at ``listen``.
    Nodes that die are restarted at most ``max_restarts`` times each within RESTARTS_WITHIN_S. ``commands`` replaces how
    nodes are started.
    ``interrupted`` is asked while the nodes come alive, which may take long with a large map: once it is true, that is
    given up. Raises NodeFailedError, SessionError, TimedOutError and StartInterruptedError.
    """

    def __init__(
        self,
        settings: NodeSettings,
        *,
        listen: str | None = None,
        max_restarts: int = MAX_RESTARTS,
        commands: Mapping[str, Sequence[str]] | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        own_router = not settings.endpoint
        self.endpoint = settings.endpoint or listen or free_endpoint()
        map_exists = settings.map_path is not None and settings.map_path.exists()
        self._settings = replace(settings, endpoint=self.endpoint, restore=map_exists)
        self._own_router = own_router
        self._max_restarts = max_restarts
        self._interrupted = interrupted
        self._commands = commands or {
            name: (sys.executable, "-m", f"seamark.service.nodes.{name}_node") for name in NODES
        }
        self._lock = threading.RLock()
        self._running: dict[str, NodeProcess] = {}
        self._started: list[NodeProcess] = []
        self._stopping = False
        self._failure: NodeFailedError | None = None
        self.restarts = dict.fromkeys(NODES, 0)
        self._restarted_at: dict[str, list[float]] = {name: [] for name in NODES}  # lately
        self._session: Any = None
        self._watch: Watch | None = None
        self._bus: ZenohBus | None = None

    def __enter__(self) -> Self:
        try:
            self._open()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop(gently=kind is None)

    @property
    def session(self) -> Any:
        """Return the Zenoh session of this process."""
        return self._session

    @property
    def bus(self) -> ZenohBus:
        """Return this process's bus, whose node is the runner."""
        if self._bus is None:
            raise NodeFailedError("the nodes are not running")
        return self._bus

    def check(self) -> None:
        """Raise NodeFailedError if a node has died for good."""
        if self._failure is not None:
            raise self._failure

    def process_id(self, node: str) -> int:
        """Return the process id of a node."""
        with self._lock:
            return self._running[node].pid

    def wait_until_alive(self, timeout_s: float = START_TIMEOUT_S) -> None:
        """Wait until all nodes answer; raises NodeFailedError or TimedOutError."""
        assert self._watch is not None
        self._watch.wait_for(NODES, timeout_s, self._check_start)

    def stop(self, gently: bool = True) -> tuple[ProcessUsage, ...]:
        """Stop frontend, vocab and backend in this order and return what each has used; may be called again.

        Each gets SIGTERM and time to finish, less if not ``gently``; what has not ended then is killed. That loses
        nothing acknowledged, and it is over in STOP_TIMEOUT_S.
        """
        with self._lock:
            self._stopping = True
        self._announce_stop()
        began, patience_s = time.monotonic(), STOP_TIMEOUT_S if gently else STOP_TIMEOUT_S / 2
        for name in NODES:
            self._stop_node(name, began + patience_s * STOP_SHARES[name])
        closing = threading.Thread(target=self._close, name="close", daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)
        if closing.is_alive():
            logger.warning("the session does not close, and ends with this process")
        return self.usage()

    def _announce_stop(self) -> None:
        """Have the back end store what is on its way and map it another time."""
        if self._bus is not None:
            with contextlib.suppress(BusError):
                self._bus.request_async(STOPPING, Empty())

    def _close(self) -> None:
        for one in (self._bus, self._watch, self._session):
            if one is not None:
                one.close()
        self._bus = self._watch = self._session = None

    def usage(self) -> tuple[ProcessUsage, ...]:
        """Return what the processes that have ended have used, restarts of one node together."""
        with self._lock:
            ended = [process for process in self._started if process.ended.is_set()]
        return tuple(
            ProcessUsage(name, max(one.peak_rss_bytes for one in mine), sum(one.cpu_s for one in mine))
            for name in NODES
            if (mine := [one for one in ended if one.name == name])
        )

    def _open(self) -> None:
        if self._own_router:
            self._session = open_session("router", listen=[self.endpoint])
        else:
            self._session = open_session("client", connect=[self.endpoint])
            if who_lives(self._session, self._settings.namespace):
                raise SessionError(
                    f"another service is alive at {self.endpoint} in namespace {self._settings.namespace!r}"
                )
        self._watch = Watch(self._session, self._settings.namespace)
        self._bus = ZenohBus(self._session, RUNNER, self._settings.namespace)
        for name in (BACKEND, VOCAB):  # readers first
            with self._lock:
                self._start(name, self._settings)
        if self._settings.restore:
            self._watch.wait_for((BACKEND, VOCAB), RESTORE_TIMEOUT_S, self._check_start)
            self._counting_on()
        with self._lock:
            self._start(FRONTEND, self._settings)
        self.wait_until_alive()

    def _check_start(self) -> None:
        self.check()
        if self._interrupted():
            raise StartInterruptedError("stopped before the nodes were alive")

    def _start(self, name: str, settings: NodeSettings) -> None:
        """Start a node; to be called with the lock, so that its end is not noticed before it is known."""
        process = self._running[name] = NodeProcess(name, self._commands[name], settings, self._on_end)
        self._started.append(process)

    def _on_end(self, process: NodeProcess) -> None:
        """Start a node again that should live."""
        with self._lock:
            if self._running.get(process.name) is process:
                del self._running[process.name]
            if self._watch is not None:
                self._watch.forget(process.name)
            if self._stopping:
                return
        self._replace(process)

    def _replace(self, ended: NodeProcess) -> None:
        sentence = f"the {ended.name} node has ended: {ended.last_word}"
        now = time.monotonic()
        lately = [at for at in self._restarted_at[ended.name] if at > now - RESTARTS_WITHIN_S]
        # An error that it could name would come again; only what was killed or crashed is worth another try.
        if ended.exit_code == 1 or len(lately) >= self._max_restarts:
            self._failure = NodeFailedError(sentence)
            return
        self._restarted_at[ended.name] = [*lately, now]
        logger.warning("%s; it is started again", sentence)
        with self._lock:
            self._settings = replace(self._settings, restore=self._settings.map_path is not None)
        if ended.name == FRONTEND:
            try:
                self._counting_on(LOST_KEYFRAMES)
            except NodeFailedError as error:
                self._failure = NodeFailedError(f"{sentence}; {error}")
                return
        with self._lock:
            if self._stopping:
                return
            self.restarts[ended.name] += 1
            try:
                self._start(ended.name, self._settings)
            except OSError as error:  # no memory, no process left: nobody would notice that the node stays away
                self._failure = NodeFailedError(f"{sentence}; it cannot be started again: {error}")

    def _counting_on(self, margin: int = 0) -> None:
        """Let the next front end go on counting after all keyframes that the last one has sent.

        Keyframes that it had announced in its odometry and not yet sent are lost; their numbers are not used again.
        """
        keyframe_id, session = self._settings.first_keyframe_id, self._settings.first_session
        for node in (VOCAB, BACKEND):
            counters = self._progress_of(node)
            keyframe_id = max(keyframe_id, counters.get("next_keyframe_id", 0))
            session = max(session, counters.get("next_session", 0))
        with self._lock:
            self._settings = replace(self._settings, first_keyframe_id=keyframe_id + margin, first_session=session)

    def _progress_of(self, node: str) -> Mapping[str, int]:
        """Return a node's counters, as soon as it says them: it may have died too, and a number that is given again
        would be taken for a keyframe that is known. Raises NodeFailedError after PROGRESS_TIMEOUT_S.
        """
        deadline = time.monotonic() + PROGRESS_TIMEOUT_S
        while not (self._stopping or self._failure or self._interrupted()):
            try:
                patience_s = min(PROGRESS[node].timeout_s, max(PROGRESS_EVERY_S, deadline - time.monotonic()))
                status: Status = self.bus.request(PROGRESS[node], Empty(), patience_s)
                return status.counters
            except BusError as error:
                logger.debug("the %s node does not say how far it is: %s", node, error)
                if time.monotonic() > deadline:
                    raise NodeFailedError(f"the {node} node lives and does not say how far it is") from error
                time.sleep(PROGRESS_EVERY_S)
        return {}

    def _stop_node(self, name: str, deadline: float) -> None:
        with self._lock:
            process = self._running.get(name)
        if process is None:
            return
        started = time.monotonic()
        process.note_memory()
        process.signal(signal.SIGTERM)
        if not process.ended.wait(max(0.0, deadline - time.monotonic())):
            logger.warning("%s has not stopped after %.0f s and is killed", name, time.monotonic() - started)
            process.signal(signal.SIGKILL)
            if not process.ended.wait(KILL_TIMEOUT_S):  # the kernel lets go of it when the disk does
                logger.error("%s (process %d) cannot be killed and is left", name, process.pid)
