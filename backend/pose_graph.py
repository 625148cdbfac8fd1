"""All keyframes' poses, from odometry and loops, by GTSAM."""

from collections.abc import Iterable

import gtsam
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import BackendConfig, DriftConfig, GraphConfig
from seamark.backend.consistency import similarity
from seamark.backend.errors import BackendInputError, SolverError
from seamark.backend.graph_types import Constraint, Estimate, Node, check_constraint, check_node
from seamark.backend.graph_variables import PoseVariables, SimilarityVariables
from seamark.frontend import se3

Matrix = NDArray[np.float64]


class PoseGraph:
    """Keyframes joined by odometry and loops, solved by iSAM2 (Kaess et al. 2012) with robust (Cauchy) loops.

    Each session starts as a component of its own in its odometry's frame. A loop between sessions joins their
    components: the older session's frame holds, the younger one is moved. Keyframes without a new loop need no solving:
    they hang on the last pose by their odometry. A loop within a component is an incremental update; joining,
    withdrawing and ``thorough`` solve all by Levenberg-Marquardt, and so does an incremental update that failed or
    did not lower the error. Metric sessions have rigid poses. From the first session without metric scale on all
    poses are similarities whose scale may drift (rigid motions in metric sessions keep it).
    """

    def __init__(self, config: BackendConfig) -> None:
        self._config: GraphConfig = config.graph
        self._drift: DriftConfig = config.drift
        self._nodes: dict[int, Node] = {}
        self._previous: dict[int, int | None] = {}
        self._members: dict[int, list[int]] = {}  # session -> its keyframes in order
        self._loops: dict[tuple[int, int], Constraint] = {}
        self._poses: dict[int, Matrix] = {}  # [sR t; 0 1] from keyframe to map
        self._frames: dict[int, int] = {}  # session -> session in whose frame its poses are
        self._variables: PoseVariables | SimilarityVariables = PoseVariables(self._config, self._drift)
        self._isam: gtsam.ISAM2 | None = None
        self._new_nodes: list[int] = []
        self._new_loops: list[tuple[int, int]] = []
        self._revision = 0

    def add_keyframe(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is malformed or was given before."""
        check_node(node)
        if node.id in self._nodes:
            raise BackendInputError(f"keyframe {node.id} was given twice")
        members = self._members.get(node.session, [])
        previous_id = node.previous_id if node.previous_id is not None else (members[-1] if members else None)
        if previous_id is not None and previous_id not in members:
            raise BackendInputError(f"keyframe {node.id} follows {previous_id}, which is not known in its session")
        if not node.metric and isinstance(self._variables, PoseVariables):
            self._variables = SimilarityVariables(self._config, self._drift)
            self._isam = None
        self._nodes[node.id] = node
        self._previous[node.id] = previous_id
        self._members.setdefault(node.session, []).append(node.id)
        self._frames.setdefault(node.session, node.session)
        if previous_id is None:
            self._poses[node.id] = node.T_odom_cam.copy()
        else:
            self._poses[node.id] = self._poses[previous_id] @ self._motion(node.id)
        self._new_nodes.append(node.id)

    def add_loop(self, constraint: Constraint) -> None:
        """Commit a loop, replacing one of the same pair; it acts at the next ``optimise``."""
        check_constraint(constraint)
        key = (constraint.query_id, constraint.match_id)
        for keyframe_id in key:
            if keyframe_id not in self._nodes:
                raise BackendInputError(f"loop {key[0]} to {key[1]} names keyframe {keyframe_id}, which is not known")
        if key in self._loops:
            self._isam = None
        self._loops[key] = constraint
        self._new_loops.append(key)

    def remove_loop(self, query_id: int, match_id: int) -> None:
        """Withdraw a loop; what it alone had joined falls apart at the next ``optimise``."""
        if self._loops.pop((query_id, match_id), None) is None:
            raise BackendInputError(f"loop {query_id} to {match_id} was never committed")
        self._isam = None

    def optimise(self, thorough: bool = False) -> Estimate:
        """Return the poses with all loops so far; raises SolverError when no finite solution is found."""
        moved = self._settle_frames()
        if moved or thorough:
            self._solve_batch()
        elif self._new_loops or self._isam is None:
            self._solve_incremental()
        self._revision += 1
        return self._estimate()

    def close(self) -> None:
        """Do nothing: this solver holds no resources."""

    def _motion(self, keyframe_id: int) -> Matrix:
        """Return the odometry's motion from the keyframe to its predecessor."""
        previous_id = self._previous[keyframe_id]
        assert previous_id is not None
        return se3.inverse(self._nodes[previous_id].T_odom_cam) @ self._nodes[keyframe_id].T_odom_cam

    def _solve_incremental(self) -> None:
        """Update iSAM2 with what is new; fall back on the batch solution when that does not help."""
        fresh = self._isam is None
        if self._isam is None:
            self._isam = self._variables.make_isam()
        nodes: Iterable[int] = self._nodes if fresh else self._new_nodes
        loops: Iterable[tuple[int, int]] = self._loops if fresh else self._new_loops
        graph, values = self._factors(nodes, loops)
        try:
            before = self._isam.getFactorsUnsafe().error(self._all_values()) + graph.error(self._all_values())
            self._isam.update(graph, values)
            error = float("inf")
            for _ in range(self._config.incremental_updates):
                self._isam.update()
                estimate = self._isam.calculateEstimate()
                last, error = error, self._isam.getFactorsUnsafe().error(estimate)
                if not error < last * (1 - 1e-4):
                    break
        except RuntimeError:  # GTSAM has no exception classes: an indeterminate or diverged system
            error, before = float("inf"), 0.0
        if not error <= before * (1 + 1e-6) + 1e-6:
            self._solve_batch()
            return
        self._keep(estimate)

    def _solve_batch(self) -> None:
        """Solve the whole graph from the current poses."""
        graph, values = self._factors(self._nodes, self._loops)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._config.batch_iterations)
        self._isam = None
        if len(self._nodes) > 0:
            try:
                estimate = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
            except RuntimeError as error:
                raise SolverError(f"the pose graph of {len(self._nodes)} keyframes has no solution: {error}") from error
            self._keep(estimate)

    def _keep(self, values: gtsam.Values) -> None:
        """Take over a solution; raises SolverError when it is not finite."""
        ids = np.array(sorted(self._nodes), np.int64)
        poses = self._variables.matrices(values, ids)
        if not np.isfinite(poses).all():
            self._isam = None
            raise SolverError(f"the pose graph of {len(ids)} keyframes has no finite solution")
        self._poses.update(zip(ids.tolist(), poses, strict=True))
        self._new_nodes.clear()
        self._new_loops.clear()

    def _factors(
        self, nodes: Iterable[int], loops: Iterable[tuple[int, int]]
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the factors and initial values that these keyframes and loops bring."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for keyframe_id in nodes:
            node, previous_id = self._nodes[keyframe_id], self._previous[keyframe_id]
            values.insert(keyframe_id, self._variables.value(self._poses[keyframe_id]))
            if previous_id is not None:
                graph.add(self._variables.odometry(previous_id, node, self._motion(keyframe_id)))
            elif self._frames[node.session] == node.session:
                graph.add(self._variables.prior(keyframe_id, self._poses[keyframe_id]))
        for key in loops:
            if key in self._loops:
                graph.add(self._variables.loop(self._loops[key]))
        return graph, values

    def _all_values(self) -> gtsam.Values:
        values = gtsam.Values()
        for keyframe_id in self._nodes:
            values.insert(keyframe_id, self._variables.value(self._poses[keyframe_id]))
        return values

    def _settle_frames(self) -> bool:
        """Move sessions into the frame of their component's oldest session; return whether any frame has changed."""
        wanted = self._components()
        changed = False
        for root in sorted(set(wanted.values())):
            if self._frames[root] != root:  # a withdrawn loop has set this component free
                first = self._members[root][0]
                G = self._nodes[first].T_odom_cam @ np.linalg.inv(self._poses[first])
                self._move(self._frames[root], root, G, wanted)
                changed = True
        pending = True
        while pending:
            pending = False
            for (query_id, match_id), constraint in sorted(self._loops.items()):
                a, b = self._nodes[match_id].session, self._nodes[query_id].session
                root = wanted[a]
                if (self._frames[a] == root) == (self._frames[b] == root):
                    continue
                S = similarity(constraint)
                if self._frames[a] == root:
                    G = self._poses[match_id] @ S @ np.linalg.inv(self._poses[query_id])
                    self._move(self._frames[b], root, G, wanted)
                else:
                    G = self._poses[query_id] @ np.linalg.inv(S) @ np.linalg.inv(self._poses[match_id])
                    self._move(self._frames[a], root, G, wanted)
                changed = pending = True
        return changed

    def _move(self, old: int, new: int, G: NDArray[np.floating], wanted: dict[int, int]) -> None:
        """Map all sessions that are in frame ``old`` and belong to component ``new`` by G into frame ``new``."""
        for session, frame in self._frames.items():
            if frame == old and wanted[session] == new:
                self._frames[session] = new
                for keyframe_id in self._members[session]:
                    self._poses[keyframe_id] = np.asarray(G @ self._poses[keyframe_id])

    def _components(self) -> dict[int, int]:
        """Return for each session the oldest one that loops join it with."""
        roots = {session: session for session in self._members}

        def root_of(session: int) -> int:
            while roots[session] != session:
                session = roots[session]
            return session

        for query_id, match_id in self._loops:
            a, b = root_of(self._nodes[query_id].session), root_of(self._nodes[match_id].session)
            roots[max(a, b)] = min(a, b)
        return {session: root_of(session) for session in roots}

    def _estimate(self) -> Estimate:
        ids = np.array(sorted(self._nodes), np.int64)
        poses = np.array([self._poses[i] for i in ids.tolist()]).reshape(-1, 4, 4)
        scales = np.ones(len(ids))  # exactly, where all is metric
        if isinstance(self._variables, SimilarityVariables):
            scales = np.cbrt(np.linalg.det(poses[:, :3, :3]))
        T_map_cam = poses.copy()
        T_map_cam[:, :3, :3] /= scales[:, None, None]
        components = np.array([self._frames[self._nodes[i].session] for i in ids.tolist()], np.int64)
        return Estimate(self._revision, ids, components, T_map_cam, scales)
