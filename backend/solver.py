"""The pose graph in a process of its own.

GTSAM holds Python's global lock while it solves: in the process that answers queries it would silence them.
"""

import multiprocessing
import signal
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, cast

from seamark import SeamarkError
from seamark.backend.config import BackendConfig
from seamark.backend.errors import SolverError
from seamark.backend.graph_types import Constraint, Estimate, Node, check_constraint, check_node

ATTEMPTS = 3
CLOSE_TIMEOUT_S = 5.0


class SolverProcess:
    """A :class:`~seamark.backend.pose_graph.PoseGraph` that lives in a spawned child; same verbs, same errors.

    The child is started at the first call. When it dies (or gives no answer for ``reply_timeout_s``) it is started
    again and fed with all it had been told; ``restarts`` counts this. It ends with its parent, whose end of the pipe
    closes. Raises SolverError when it cannot be kept alive. To be used by one thread.
    """

    def __init__(self, config: BackendConfig, reply_timeout_s: float = 300.0) -> None:
        self._config = config
        self._reply_timeout_s = reply_timeout_s
        self._told: list[tuple[str, tuple[Any, ...]]] = []
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._revision = 0
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """The child's process id, None before the first call and after ``close``."""
        return self._process.pid if self._process is not None else None

    def add_keyframe(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is malformed or was given before."""
        check_node(node)
        self._tell("add_keyframe", node)

    def add_loop(self, constraint: Constraint) -> None:
        """Commit a loop; it acts at the next ``optimise``."""
        check_constraint(constraint)
        self._tell("add_loop", constraint)

    def remove_loop(self, query_id: int, match_id: int) -> None:
        """Withdraw a loop; it ceases to act at the next ``optimise``."""
        self._tell("remove_loop", query_id, match_id)

    def optimise(self, thorough: bool = False) -> Estimate:
        """Return the poses with all loops so far; revisions go on counting when the child is started again."""
        estimate = cast(Estimate, self._call("optimise", (thorough,)))
        self._revision += 1
        return replace(estimate, revision=self._revision)

    def close(self) -> None:
        """End the child, by force where it does not end by itself; harmless when repeated."""
        if self._connection is not None:
            self._connection.close()  # the child reads the end of the pipe and returns
        if self._process is not None:
            self._process.join(CLOSE_TIMEOUT_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
            self._process.close()
        self._connection = self._process = None

    def _tell(self, verb: str, *arguments: object) -> None:
        """Call a verb that changes the graph, and remember it for a new child once it has succeeded."""
        self._call(verb, arguments)
        self._told.append((verb, arguments))

    def _call(self, verb: str, arguments: tuple[Any, ...]) -> object:
        for _ in range(ATTEMPTS):
            try:
                if self._process is None:
                    self._start()
                return self._ask(verb, arguments)
            except (EOFError, OSError):
                self._kill()
                self.restarts += 1
        raise SolverError(f"the solver process died {ATTEMPTS} times in a row at {verb}")

    def _start(self) -> None:
        """Start a child and repeat to it all that its predecessor had been told."""
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._config), name="seamark-solver", daemon=True)
        self._process.start()
        theirs.close()  # or the end of the child would not be noticed
        for verb, arguments in self._told:
            self._ask(verb, arguments)

    def _ask(self, verb: str, arguments: tuple[Any, ...]) -> object:
        assert self._connection is not None
        self._connection.send((verb, arguments))
        if not self._connection.poll(self._reply_timeout_s):
            raise EOFError
        succeeded, value = self._connection.recv()
        if not succeeded:
            raise value
        return value

    def _kill(self) -> None:
        if self._process is not None and self._process.is_alive():
            self._process.kill()
        self.close()


def _serve(connection: Connection, config: BackendConfig) -> None:
    """Answer calls until the pipe ends; the child's main function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends us in order
    from seamark.backend.pose_graph import PoseGraph  # GTSAM is loaded here and never in the parent

    graph = PoseGraph(config)
    while True:
        try:
            verb, arguments = connection.recv()
        except EOFError:
            return
        method: Callable[..., object] = getattr(graph, verb)
        try:
            answer: tuple[bool, object] = (True, method(*arguments))
        except SeamarkError as error:
            answer = (False, error)
        try:
            connection.send(answer)
        except OSError:
            return
