"""Keyframes and place candidates to verified loops and one consistent map."""

import logging
import threading
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from seamark.backend.adjustment import Adjustment
from seamark.backend.config import BackendConfig
from seamark.backend.contraction import contract
from seamark.backend.errors import BackendInputError
from seamark.backend.evidence import Evidence
from seamark.backend.graph_types import Estimate, Graph, Key, Matrix, Node, Solver, Span, check_nodes
from seamark.backend.ledger import Finding
from seamark.backend.loop_verdicts import LoopVerdicts
from seamark.backend.map_contraction import Contracted, Mean, contracted
from seamark.backend.map_memory import KeyframeMemory, Load
from seamark.backend.map_state import MapState, StoredPose
from seamark.backend.types import Loop, MapSnapshot, Place, Reason
from seamark.backend.verify import Rejected, Verification
from seamark.backend.verify_candidates import CandidateVerifier, Verified
from seamark.frontend.types import Keyframe, Mode
from seamark.vocab.types import Candidate, Candidates

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StepResult:
    """What one keyframe has brought.

    ``loops``: one per verified candidate, and earlier ones whose verdict has changed. ``optimised``: whether poses of
    earlier keyframes may have moved. ``timings_ms`` per stage: verify, consistency, optimise.
    """

    loops: tuple[Loop, ...]
    revision: int
    optimised: bool
    timings_ms: dict[str, float] = field(default_factory=dict)


class Slam:
    """The back end's memory and its decisions.

    ``solver`` is a PoseGraph or SolverProcess; None only in mode places, which knows no poses. ``step`` and ``finish``
    belong to one thread, ``locate`` and ``snapshot`` may be called from others. Features and landmarks stay in memory
    within the budget ``config.map.memory_mb`` if ``load`` reads those of a keyframe again, else all of them; images do
    not. Same input and ``seed``, same result.
    """

    def __init__(
        self, config: BackendConfig, mode: Mode, solver: Solver | None, seed: int, load: Load | None = None
    ) -> None:
        if (mode == Mode.PLACES) != (solver is None):
            raise BackendInputError(f"mode {mode} needs {'no' if mode == Mode.PLACES else 'a'} solver")
        self._config, self._mode, self._solver = config, mode, solver
        self._verdicts = LoopVerdicts(config, mode)
        self._map = MapState()
        self._unsolved = False
        self._memory = KeyframeMemory(config.map.memory_mb << 20, load)
        self._verifier = CandidateVerifier(config, mode, seed, self._memory)
        self._loops: dict[Key, Loop] = {}
        self._means: dict[Key, Mean] = {}  # of composed loops
        self._adjustments: tuple[Adjustment, ...] = ()  # whether they stand or not
        self._committed: set[Key] = set()  # the accepted loops, as far as the graph has been told
        self._evidence: dict[Key, Evidence | None] = {}  # of the last step; all of it would be memory without bound
        self._lock = threading.Lock()

    def __contains__(self, keyframe_id: int) -> bool:
        """Return whether the keyframe has been taken in: messages may be delivered twice."""
        return keyframe_id in self._map.keyframes

    @property
    def localised(self) -> bool:
        """Return whether the newest session lies in the frame of reference of an earlier one, or is the first of all
        (true where there are no poses).

        Until it does, the map is a prior to it and says nothing of where it is.
        """
        return self._solver is None or self._map.localised

    @property
    def feature_bytes(self) -> int:
        """Return how many bytes the features in memory take."""
        return self._memory.n_bytes

    def step(self, keyframe: Keyframe, candidates: Candidates) -> StepResult:
        """Take in a keyframe and the places that it may show; raises BackendInputError when it is malformed."""
        timings_ms = {}
        # Hang the keyframe on its predecessor by odometry.
        self._add(keyframe)
        self._evidence = {}

        # Verify one candidate per island of neighbouring keyframes, the best first.
        started = time.perf_counter()
        verified = self._verify(keyframe, candidates)
        timings_ms["verify"] = 1e3 * (time.perf_counter() - started)

        # Gate by odometry, then judge by mutual consistency with all loops so far.
        started = time.perf_counter()
        changed: dict[Key, None] = {}
        for candidate, result in verified:
            changed |= dict.fromkeys(self._enter(keyframe, candidate, result))
        timings_ms["consistency"] = 1e3 * (time.perf_counter() - started)

        # Commit what is accepted, withdraw what no longer is, and solve.
        started = time.perf_counter()
        if self._unsolved and self._solver is not None:
            self._unsolved = False
            self._solver.request()
        committed = self._commit([key for key in changed if self._loops[key].accepted != (key in self._committed)])
        optimised = self._collect(self._config.graph.solve_wait_ms / 1e3 if committed else 0.0)
        timings_ms["optimise"] = 1e3 * (time.perf_counter() - started)
        loops = tuple(replace(self._loops[key], evidence=self._evidence.get(key)) for key in changed)
        return StepResult(loops, self._map.revision, optimised, timings_ms)

    def finish(self) -> StepResult:
        """Solve thoroughly; loops that still wait for confirmation keep their verdict UNCONFIRMED, not accepted."""
        started = time.perf_counter()
        optimised = self._solver is not None and len(self._map.keyframes) > 0
        if self._solver is not None and optimised:
            self._take(self._solver.optimise(thorough=True))
        return StepResult((), self._map.revision, optimised, {"optimise": 1e3 * (time.perf_counter() - started)})

    def snapshot(self) -> MapSnapshot:
        """Return the whole map: all keyframes, and one row per verified loop with its last verdict."""
        with self._lock:
            return self._map.snapshot(tuple(self._loops.values()))

    def restore(
        self,
        keyframes: Iterable[Keyframe],
        loops: Iterable[Loop],
        poses: Mapping[int, StoredPose] | None = None,
        revision: int = 0,
        spans: Mapping[int, Span] | None = None,
        means: Mapping[Key, Mean] | None = None,
        adjustments: Sequence[Adjustment] = (),
        *,
        held: bool = False,
    ) -> None:
        """Take in what a map on disk holds (keyframes in order of id, features or not), accepted loops unasked.

        With ``poses``, those of the map at ``revision``, nothing is solved; without, all is. ``spans`` and ``means``
        are what the map has of keyframes that have gone, ``adjustments`` what full ones have found. ``held``: these
        poses are never changed.
        """
        self._means, self._adjustments = dict(means or {}), tuple(adjustments) if poses else ()
        nodes = self._hold(list(keyframes), poses, spans)
        findings: list[Finding] = []
        for loop in loops:
            with self._lock:
                self._loops[loop.query_id, loop.match_id] = loop
            if loop.accepted and (self._solver is None or loop.T_match_query is not None):
                mean = self._means.get((loop.query_id, loop.match_id))
                scale_sigma = None if mean is None else mean.scale_sigma
                findings.append(self._verdicts.finding_of(loop, self._map.keyframes, scale_sigma))
        self._verdicts.restore(findings)
        accepted = {finding.key: finding.constraint for finding in findings}
        if poses and self._solver is not None:
            self._map.revision = revision
            constraints = [constraint for constraint in accepted.values() if constraint is not None]
            self._solver.restore(Graph(nodes, constraints, self._map.estimate(), self._adjustments), held=held)
            self._committed |= set(accepted)
            # Loops may have come after the last solution: the next keyframe asks.
            self._unsolved = bool(accepted) and not held
            return
        for node in nodes:
            if self._solver is not None:
                self._solver.add_keyframe(node)
        if self._commit(list(accepted)) and self._solver is not None:
            self._take(self._solver.optimise())

    def without(self, keyframe_ids: Collection[int]) -> Contracted:
        """Say what the map is without these keyframes; it becomes that when it is told to ``adopt`` it."""
        nodes = self._verdicts.nodes()
        if self._solver is None:
            keyframes = self._map.keyframes.values()
            nothing = np.zeros((6, 6))
            nodes = tuple(Node(one.id, one.session, one.previous_id, np.eye(4), nothing) for one in keyframes)
        found = (self._verdicts.constraint(key) for key in sorted(self._committed))
        constraints = [constraint for constraint in found if constraint is not None]
        counts = {key: mean.count for key, mean in self._means.items()}
        graph = contract(nodes, constraints, keyframe_ids, self._config.drift, counts)
        standing = [one for one in self._adjustments if one.stands(self._committed)]
        return contracted(graph, self._loops, self._map.components(), standing)

    def adopt(self, change: Contracted) -> None:
        """Be the map that ``without`` has said; poses stay what they are until the next solution."""
        composed = {(loop.query_id, loop.match_id): loop for loop in change.loops}
        with self._lock:
            self._loops = {key: loop for key, loop in self._loops.items() if change.stays(key)} | composed
            self._map.contract(change.graph.nodes, change.components)
        self._memory.forget(change.graph.gone)
        self._means = {key: mean for key, mean in self._means.items() if change.stays(key)} | change.means()
        self._adjustments = change.adjustments
        self._verdicts = LoopVerdicts(self._config, self._mode, () if self._solver is None else change.graph.nodes)
        if self._solver is not None:
            loops = list(change.graph.loops.values())
            self._solver.exchange(Graph(change.graph.nodes, loops, self._map.estimate(), change.adjustments))
        self._committed = {key for key in self._committed if change.stays(key)} | set(composed)
        findings = [self._verdicts.finding_of(self._loops[key], self._map.keyframes) for key in sorted(self._committed)]
        given = change.graph.loops
        self._verdicts.restore(
            [replace(one, constraint=given[one.key]) if one.key in given else one for one in findings]
        )
        self._unsolved = bool(change.graph.loops)

    def locate(self, query: Keyframe, candidates: Candidates) -> tuple[Place, ...]:
        """Say where one image was taken: the verified candidates, localised ones first, then by inliers.

        ``query`` has id -1 and no pose. Safe to call from another thread than ``step``.
        """
        with self._lock:
            known = self._map.keyframes.copy()
        return self._verifier.of_image(query, candidates, known, self._pose_of_neighbour)

    def _add(self, keyframe: Keyframe) -> None:
        """Take the keyframe into memory and, but in mode places, into the graph."""
        for node in self._hold([keyframe]):
            assert self._solver is not None
            self._solver.add_keyframe(node)

    def _hold(
        self,
        keyframes: Sequence[Keyframe],
        poses: Mapping[int, StoredPose] | None = None,
        spans: Mapping[int, Span] | None = None,
    ) -> list[Node]:
        """Take keyframes into memory, all or none; return what the graph is to know of them, in mode places nothing."""
        twice = [one.id for one in keyframes if one.id in self._map.keyframes]
        if twice:
            raise BackendInputError(f"keyframe {twice[0]} was given twice")
        nodes: list[Node] = []
        if self._solver is not None:
            nodes = [_node_of(one, None if spans is None else spans.get(one.id)) for one in keyframes]
            check_nodes(nodes)
            self._verdicts.extend(nodes)
        with self._lock:
            for one in keyframes:
                self._map.add(self._memory.add(one), None if poses is None else poses.get(one.id))
        return nodes

    def _verify(self, keyframe: Keyframe, candidates: Candidates) -> Verified:
        return self._verifier.of_keyframe(keyframe, candidates, self._map.keyframes)

    def _enter(self, keyframe: Keyframe, candidate: Candidate, result: Verification | Rejected) -> list[Key]:
        """Write the loop's row with its verdict; return the rows that are new or changed."""
        loop, verdicts = self._verdicts.enter(keyframe.id, candidate, result, self._map.keyframes)
        key = (loop.query_id, loop.match_id)
        self._evidence[key] = loop.evidence
        with self._lock:
            self._loops[key] = replace(loop, evidence=None)
            for changed, reason in verdicts.items():
                row = self._loops[changed]
                self._loops[changed] = replace(row, accepted=reason == Reason.ACCEPTED, reason=reason)
        return [key, *verdicts]

    def _commit(self, keys: list[Key]) -> bool:
        """Bring the graph in line with these loops' verdicts and have it solved; return whether it will be."""
        if not keys:
            return False
        accepted = {key for key in keys if self._loops[key].accepted}
        before = [one.stands(self._committed) for one in self._adjustments]
        self._committed.difference_update(keys)
        self._committed |= accepted
        for one, stood in zip(self._adjustments, before, strict=True):
            if stood != one.stands(self._committed):
                what = "no longer stands: a loop that it rests on was withdrawn" if stood else "stands again"
                logger.warning("the full adjustment of %d keyframes %s", len(one.poses), what)
        if self._solver is None:
            with self._lock:
                self._map.revision += 1
            return False
        for key in keys:
            constraint = self._verdicts.constraint(key)
            if key in accepted and constraint is not None:
                self._solver.add_loop(constraint)
            else:
                self._solver.remove_loop(*key)
        self._solver.request()
        return True

    def _collect(self, wait_s: float) -> bool:
        """Take over a solution that is there; one that takes longer than ``wait_s`` is taken at a later keyframe.

        No verdict depends on it: those are made from odometry and loops alone.
        """
        estimate = None if self._solver is None else self._solver.collect(wait_s)
        if estimate is not None:
            self._take(estimate)
        return estimate is not None

    def _take(self, estimate: Estimate) -> None:
        with self._lock:
            self._map.take(estimate)

    def _pose_of_neighbour(self, keyframe_id: int, T_keyframe_cam: Matrix) -> Matrix | None:
        with self._lock:
            return self._map.pose_of_neighbour(keyframe_id, T_keyframe_cam)


def _node_of(keyframe: Keyframe, span: Span | None) -> Node:
    """Return what the graph knows of a keyframe; raises BackendInputError for one without odometry."""
    if keyframe.T_odom_cam is None:
        raise BackendInputError(f"keyframe {keyframe.id} ({keyframe.file}) has no odometry pose")
    covariance = np.zeros((6, 6)) if keyframe.covariance is None else keyframe.covariance
    own = (keyframe.id, keyframe.session, keyframe.previous_id)
    return Node(*own, keyframe.T_odom_cam, covariance, keyframe.metric, span)
