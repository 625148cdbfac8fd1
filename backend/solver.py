"""The pose graph in a process of its own.

GTSAM holds Python's global lock while it solves: in the process that answers queries it would silence them.
"""

import contextlib
import fcntl
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, cast

from seamark import SeamarkError
from seamark.backend.config import BackendConfig
from seamark.backend.errors import BackendInputError, SolverError
from seamark.backend.graph_types import (
    Constraint,
    Estimate,
    Graph,
    Key,
    Matrix,
    Node,
    check_constraint,
    check_node,
    check_nodes,
)

Tells = list[tuple[str, tuple[Any, ...]]]

ATTEMPTS = 3
CLOSE_TIMEOUT_S = 1.0


class SolverProcess:
    """A :class:`~seamark.backend.pose_graph.PoseGraph` that lives in a spawned child; same verbs, same errors.

    What is told is kept here until something is asked, so telling costs nothing, however busy the child is. ``request``
    has the child solve while its parent goes on; what is told meanwhile waits for the next request. The child is
    started at the first question. When it dies (or gives no answer for ``reply_timeout_s``) it is started again and
    fed with all it had been told; ``restarts`` counts this. It ends with its parent, even in the midst of solving.
    Raises SolverError when it cannot be kept alive. To be used by one thread.
    """

    def __init__(self, config: BackendConfig, reply_timeout_s: float = 300.0) -> None:
        self._config = config
        self._reply_timeout_s = reply_timeout_s
        self._told: Tells = []
        self._sent = 0  # how much of it the child has heard
        self._keyframes: set[int] = set()
        self._loops: set[Key] = set()
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._sending: threading.Thread | None = None
        self._asked_at: float | None = None  # when the question was put that is still unanswered
        self._wanted = False  # another solution, once this one is there
        self._outdated = False  # the one that is being made is of a graph that was exchanged since
        self._failures = 0
        self._revision = 0
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """The child's process id, None before the first question and after ``close``."""
        return self._process.pid if self._process is not None else None

    def add_keyframe(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is malformed or was given before."""
        check_node(node)
        if node.id in self._keyframes:
            raise BackendInputError(f"keyframe {node.id} was given twice")
        self._keyframes.add(node.id)
        self._told.append(("add_keyframe", (node,)))

    def restore(self, graph: Graph, held: bool = False) -> None:
        """Take in a graph that was solved before, ``held`` or not; the child hears of it when it is first needed."""
        check_nodes(graph.nodes)
        self._keyframes |= {node.id for node in graph.nodes}
        self._loops |= {constraint.key for constraint in graph.loops}
        self._told.append(("restore", (graph, held)))
        self._revision = graph.estimate.revision

    def exchange(self, graph: Graph) -> None:
        """Take in another graph, as ``restore`` does, in place of all that was told before."""
        self._told, self._sent = [("exchange", (graph,))], 0
        self._keyframes = {node.id for node in graph.nodes}
        self._loops = {constraint.key for constraint in graph.loops}
        self._revision = graph.estimate.revision
        self._outdated = self._asked_at is not None

    def add_loop(self, constraint: Constraint) -> None:
        """Commit a loop; it acts at the next solution."""
        check_constraint(constraint)
        for keyframe_id in constraint.key:
            if keyframe_id not in self._keyframes:
                raise BackendInputError(f"{constraint.name} names keyframe {keyframe_id}, which is not known")
        self._loops.add(constraint.key)
        self._told.append(("add_loop", (constraint,)))

    def remove_loop(self, query_id: int, match_id: int) -> None:
        """Withdraw a loop; it ceases to act at the next solution."""
        if (query_id, match_id) not in self._loops:
            raise BackendInputError(f"loop {query_id} to {match_id} was never committed")
        self._loops.remove((query_id, match_id))
        self._told.append(("remove_loop", (query_id, match_id)))

    def request(self) -> None:
        """Have the child solve for all that was told so far; where it is solving already, after that."""
        if self._asked_at is not None:
            self._wanted = True
            return
        try:
            self._put("optimise", (False,))
        except (EOFError, OSError):
            self._revive()

    def collect(self, wait_s: float = 0.0) -> Estimate | None:
        """Return the solution that was requested, None when it is not there within ``wait_s``; raises SolverError."""
        if self._asked_at is None:
            return None
        try:
            answer = self._answer(wait_s)
        except (EOFError, OSError):
            self._revive()
            return None
        if answer is None:
            return None
        outdated, self._outdated = self._outdated, False
        if self._wanted or outdated:
            self._wanted = False
            self.request()
        return None if outdated else self._numbered(_value(answer))

    def optimise(self, thorough: bool = False) -> Estimate:
        """Return the poses with all loops so far; revisions go on counting when the child is started again."""
        return self._numbered(self._ask("optimise", (thorough,)))

    def weights(self) -> dict[Key, float]:
        """Return the weight (0..1) that the robust kernel leaves each loop in the last solution."""
        return cast(dict[Key, float], self._ask("weights", ()))

    def covariances(self, keyframe_ids: Sequence[int]) -> Matrix:
        """Return the marginal covariances (K, 6, 6) of poses; see PoseGraph.covariances."""
        return cast(Matrix, self._ask("covariances", (tuple(keyframe_ids),)))

    def close(self) -> None:
        """End the child, by force where it does not end by itself; harmless when repeated."""
        if self._sending is not None and self._sending.is_alive():
            if self._process is not None:
                self._process.kill()  # or it would go on reading, and the thread writing to what is closed below
            self._sending.join()
        self._sending = None
        if self._connection is not None:
            self._connection.close()  # the child reads the end of the pipe, or is ended by it while it solves
        if self._process is not None:
            self._process.join(CLOSE_TIMEOUT_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            self._process.close()
        self._connection = self._process = self._asked_at = None
        self._sent, self._outdated = 0, False

    def _numbered(self, value: object) -> Estimate:
        self._revision += 1
        return replace(cast(Estimate, value), revision=self._revision)

    def _ask(self, verb: str, arguments: tuple[Any, ...]) -> object:
        """Return the child's answer to a question, however long that takes."""
        for _ in range(ATTEMPTS):
            try:
                if self._asked_at is not None:
                    self._answer(self._reply_timeout_s)  # an earlier solution, which this question outdates
                self._wanted = self._outdated = False
                self._put(verb, arguments)
                answer = self._answer(self._reply_timeout_s)
                assert answer is not None
                return _value(answer)
            except (EOFError, OSError):
                self._end()
        raise SolverError(f"the solver process died {ATTEMPTS} times in a row at {verb}")

    def _put(self, verb: str, arguments: tuple[Any, ...]) -> None:
        """Send a question, and before it what the child has not heard."""
        if self._process is None:
            self._start()
        assert self._connection is not None
        news = self._told[self._sent :]
        # A large map does not fit into the pipe, and the child reads it only once it has loaded GTSAM.
        told = (self._connection, (news, verb, arguments))
        self._sending = threading.Thread(target=_send, args=told, name="to-solver", daemon=True)
        self._sending.start()
        self._sent = len(self._told)
        self._asked_at = time.monotonic()

    def _answer(self, wait_s: float) -> tuple[bool, object] | None:
        """Return the answer, None when it is not there yet; raises EOFError when it is overdue."""
        assert self._connection is not None and self._asked_at is not None
        if not self._connection.poll(wait_s):
            if time.monotonic() - self._asked_at >= self._reply_timeout_s:
                raise EOFError
            return None
        answer = cast(tuple[bool, object], self._connection.recv())
        self._asked_at = None
        self._failures = 0
        return answer

    def _revive(self) -> None:
        """Start the child again and put the request again; raises SolverError when that has failed too often."""
        self._end()
        self._failures += 1
        if self._failures >= ATTEMPTS:
            self._failures = 0
            raise SolverError(f"the solver process died {ATTEMPTS} times in a row")
        self._wanted = False
        self.request()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._config), name="seamark-solver", daemon=True)
        self._process.start()
        theirs.close()  # or the end of the child would not be noticed
        self._sent = 0

    def _end(self) -> None:
        """Put an end to a child that has failed."""
        if self._process is not None and self._process.is_alive():
            self._process.kill()
        self.close()
        self.restarts += 1


def _send(connection: Connection, message: tuple[Tells, str, tuple[Any, ...]]) -> None:
    """Send a question; a child that has died meanwhile shows itself where the answer is expected."""
    with contextlib.suppress(OSError):
        connection.send(message)


def _value(answer: tuple[bool, object]) -> object:
    """Return what the child has answered, or raise what it has raised."""
    succeeded, value = answer
    if not succeeded:
        assert isinstance(value, SeamarkError)
        raise value
    return value


def _serve(connection: Connection, config: BackendConfig) -> None:
    """Answer questions until the pipe ends; the child's main function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends us in order
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    from seamark.backend.pose_graph import PoseGraph  # GTSAM is loaded here and never in the parent

    graph = PoseGraph(config)
    while True:
        try:
            news, verb, arguments = connection.recv()
            _end_with_the_pipe(connection, True)
            if connection.poll(0):
                return  # nothing is sent while we work: this is the end of the pipe
            answer: tuple[bool, object]
            try:
                for told, what in news:
                    getattr(graph, told)(*what)
                answer = (True, getattr(graph, verb)(*arguments))
            except SeamarkError as error:
                answer = (False, error)
            _end_with_the_pipe(connection, False)
            connection.send(answer)
        except (EOFError, OSError):
            return


def _end_with_the_pipe(connection: Connection, enabled: bool) -> None:
    """Have the kernel end this process when the pipe ends, while GTSAM works and no line of Python can run."""
    if enabled:
        fcntl.fcntl(connection.fileno(), fcntl.F_SETOWN, os.getpid())
        if hasattr(fcntl, "F_SETSIG"):
            fcntl.fcntl(connection.fileno(), fcntl.F_SETSIG, signal.SIGTERM)
    flags = fcntl.fcntl(connection.fileno(), fcntl.F_GETFL)
    asynchronous = flags | os.O_ASYNC if enabled else flags & ~os.O_ASYNC
    fcntl.fcntl(connection.fileno(), fcntl.F_SETFL, asynchronous)
