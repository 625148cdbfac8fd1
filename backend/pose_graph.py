"""All keyframes' poses, from odometry and loops, by GTSAM."""

from collections.abc import Iterable, Sequence
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from seamark.backend.adjustment import Adjustments
from seamark.backend.chain import OdometryChains, white_covariances
from seamark.backend.config import BackendConfig, DriftConfig, GraphConfig
from seamark.backend.consistency import chi_squared, cycle_error, similarity
from seamark.backend.drift import drift_share
from seamark.backend.errors import BackendInputError, SolverError
from seamark.backend.graph_poses import GraphPoses
from seamark.backend.graph_types import Constraint, Estimate, Graph, Key, Node, check_constraints
from seamark.backend.graph_variables import PlanarVariables, PoseVariables, SimilarityVariables
from seamark.frontend import se3

Matrix = NDArray[np.float64]
HELD_SIGMA: Final = 1e-5  # rad and units of length: nothing that is measured moves such a pose
STRETCH: Final = 10  # loops of so many neighbouring keyframes close the same way


class PoseGraph:
    """Keyframes joined by odometry and loops, solved by iSAM2 (Kaess et al. 2012) with robust (Cauchy) loops.

    Keyframes without a new loop need no solving: they hang on the last pose by their odometry. A loop within a
    component (see :class:`~seamark.backend.graph_poses.GraphPoses`) is an incremental update; joining, withdrawing and
    ``thorough`` solve all by Levenberg-Marquardt, and so does an incremental update that failed or did not lower the
    error. Metric sessions have rigid poses. From the first session without metric scale on all poses are similarities
    whose scale may drift (rigid motions in metric sessions keep it). ``planar``: all motions are in the plane z = 0,
    and so are the poses.
    """

    def __init__(self, config: BackendConfig, planar: bool = False) -> None:
        self._config: GraphConfig = config.graph
        self._drift: DriftConfig = config.drift
        self._kind = PlanarVariables if planar else PoseVariables
        self._revision = 0
        self._clear()

    def _clear(self) -> None:
        """Begin without keyframes."""
        self._poses = GraphPoses()
        self._loops: dict[Key, Constraint] = {}
        self._variables: PoseVariables = self._kind(self._config, self._drift)
        self._isam: gtsam.ISAM2 | None = None
        self._solved_rows = 0  # those that iSAM2 knows
        self._held_rows = 0  # those whose poses are given
        self._new_loops: list[Key] = []
        self._adjustments = Adjustments()
        self._chains = OdometryChains(self._drift)
        self._chained = 0  # rows that the chains know
        self._share = 1.0  # of the drift allowed for that the loops bear out
        self._requested = False

    def add_keyframe(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is malformed or was given before."""
        self.add_keyframes([node])

    def add_keyframes(self, nodes: Sequence[Node]) -> None:
        """Append keyframes; raises BackendInputError at the first that is malformed or was given before."""
        self._poses.extend(nodes)
        if not all(node.metric for node in nodes) and not isinstance(self._variables, SimilarityVariables):
            self._variables = SimilarityVariables(self._config, self._drift)
            self._isam = None

    def restore(self, graph: Graph, held: bool = False) -> None:
        """Take in a graph that was solved before, with the poses of all nodes: nothing is solved until it has to be.

        With ``held`` these poses stay for good, and what joins them with each other is of no more use.
        """
        self.add_keyframes(graph.nodes)
        self._poses.take(graph.estimate)
        self.add_loops(graph.loops)
        self._adjustments = Adjustments(graph.adjustments)
        self._adjustments.update(self._loops)
        self._revision = graph.estimate.revision
        self._held_rows = len(self._poses) if held else 0

    def exchange(self, graph: Graph) -> None:
        """Take in another graph, as ``restore`` does, in place of all that was told before."""
        self._clear()
        self.restore(graph)

    def add_loop(self, constraint: Constraint) -> None:
        """Commit a loop, replacing one of the same pair; it acts at the next ``optimise``."""
        self.add_loops([constraint])

    def add_loops(self, constraints: Sequence[Constraint]) -> None:
        """Commit loops, as ``add_loop`` does; where one is malformed none of them."""
        check_constraints(constraints)
        for constraint in constraints:
            for keyframe_id in constraint.key:
                if keyframe_id not in self._poses.rows:
                    raise BackendInputError(f"{constraint.name} names keyframe {keyframe_id}, which is not known")
        for constraint in constraints:
            key = constraint.key
            if key in self._loops:
                self._isam = None
            self._loops[key] = constraint
            self._new_loops.append(key)

    def remove_loop(self, query_id: int, match_id: int) -> None:
        """Withdraw a loop; what it alone had joined falls apart at the next ``optimise``."""
        if self._loops.pop((query_id, match_id), None) is None:
            raise BackendInputError(f"loop {query_id} to {match_id} was never committed")
        self._isam = None

    def request(self) -> None:
        """Ask for a solution; here it is made when it is collected."""
        self._requested = True

    def collect(self, wait_s: float = 0.0) -> Estimate | None:
        """Return the solution that was requested, None when none was."""
        if not self._requested:
            return None
        self._requested = False
        return self.optimise()

    def optimise(self, thorough: bool = False) -> Estimate:
        """Return the poses with all loops so far; raises SolverError when no finite solution is found."""
        moved = self._poses.settle(self._loops)
        moved |= self._adjustments.update(self._loops)
        self._learn_drift()
        if moved or thorough:
            self._solve_batch()
        elif self._new_loops or self._isam is None:
            self._solve_incremental()
        self._revision += 1
        return self._poses.estimate(self._revision, isinstance(self._variables, SimilarityVariables))

    def weights(self) -> dict[Key, float]:
        """Return the weight (0..1) that the robust kernel leaves each loop at the present poses."""
        if not self._loops:
            return {}
        loops = list(self._loops.values())
        query, match = (self._poses.matrices[[self._poses.rows[key[end]] for key in self._loops]] for end in (0, 1))
        expected = np.linalg.inv(match) @ query
        error, log_scale = cycle_error(np.linalg.inv(np.stack([similarity(loop) for loop in loops])) @ expected)
        covariance = np.stack([loop.covariance for loop in loops])
        scale_variance = np.array([loop.scale_sigma**2 for loop in loops])
        chi2 = chi_squared(error, covariance, log_scale, scale_variance)
        weights = 1 / (1 + chi2 / self._config.cauchy_width**2)
        return dict(zip(self._loops, weights.tolist(), strict=True))

    def covariances(self, keyframe_ids: Sequence[int]) -> Matrix:
        """Return the marginal covariances (K, 6, 6) of poses, each in its keyframe's frame, rotation first.

        Relative to the first keyframe of the component, as of the last ``optimise``. Raises BackendInputError for a
        keyframe that is not known, SolverError where the system is indeterminate.
        """
        unknown = [keyframe_id for keyframe_id in keyframe_ids if keyframe_id not in self._poses.rows]
        if unknown:
            raise BackendInputError(f"keyframe {unknown[0]} is not known")
        try:
            if self._isam is None or self._solved_rows < len(self._poses):
                self._solve_incremental()
            assert self._isam is not None
            blocks = [self._isam.marginalCovariance(keyframe_id) for keyframe_id in keyframe_ids]
        except RuntimeError as error:
            raise SolverError(f"the covariance of keyframes {list(keyframe_ids)} cannot be had: {error}") from error
        return np.array([self._variables.covariance(block) for block in blocks]).reshape(-1, 6, 6)

    def close(self) -> None:
        """Do nothing: this solver holds no resources."""

    def _learn_drift(self) -> None:
        """Ask the loops how much odometry drifts, when there are new ones."""
        if not self._config.learn_drift or not self._new_loops:
            return
        if self._chained < len(self._poses):
            self._chains.extend(self._poses.nodes[self._chained :])
            self._chained = len(self._poses)
        share = drift_share(list(self._loops.values()), self._chains, STRETCH)
        if share != self._share:
            self._share, self._isam = share, None

    def _solve_incremental(self) -> None:
        """Update iSAM2 with what is new; fall back on the batch solution when that does not help."""
        fresh = self._isam is None
        if self._isam is None:
            self._isam = self._variables.make_isam()
        rows = range(0 if fresh else self._solved_rows, len(self._poses))
        graph = self._factors(rows, self._loops if fresh else self._new_loops)
        values = self._values(rows)
        try:
            error = before = self._isam.getFactorsUnsafe().error(self._isam.calculateEstimate())
            before += graph.error(values if fresh else self._values(self._poses.rows[key] for key in graph.keyVector()))
            self._isam.update(graph, values)
            for _ in range(self._config.incremental_updates):
                if self._isam.update().getVariablesRelinearized() == 0:
                    break
            estimate = self._isam.calculateEstimate()
            error = self._isam.getFactorsUnsafe().error(estimate)
        except RuntimeError:  # GTSAM has no exception classes: an indeterminate or diverged system
            error, before = float("inf"), 0.0
        if not error <= before * (1 + 1e-6) + 1e-6:
            self._solve_batch()
            return
        self._keep(estimate)
        self._solved_rows = len(self._poses)

    def _solve_batch(self) -> None:
        """Solve the whole graph from the current poses."""
        self._isam = None
        if not len(self._poses):
            return
        rows = range(len(self._poses))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._config.batch_iterations)
        try:
            graph = self._factors(rows, self._loops)
            estimate = gtsam.LevenbergMarquardtOptimizer(graph, self._values(rows), parameters).optimize()
        except RuntimeError as error:
            raise SolverError(f"the pose graph of {len(self._poses)} keyframes has no solution: {error}") from error
        self._keep(estimate)

    def _keep(self, values: gtsam.Values) -> None:
        """Take over a solution; raises SolverError when it is not finite."""
        ids, rows = self._poses.by_id()
        poses = self._variables.matrices(values, ids)
        if not np.isfinite(poses).all():
            self._isam = None
            raise SolverError(f"the pose graph of {len(ids)} keyframes has no finite solution")
        free = rows >= self._held_rows  # the others are held by strong priors, which give way by micrometres
        self._poses.matrices[rows[free]] = poses[free]
        self._new_loops.clear()

    def _factors(self, rows: Sequence[int], loops: Iterable[Key]) -> gtsam.NonlinearFactorGraph:
        """Return the factors that these keyframes and loops bring."""
        graph = gtsam.NonlinearFactorGraph()
        poses, held = self._poses, self._held_rows
        joined = [row for row in rows if poses.before[row] >= 0 and row >= held]
        for row in rows:
            node = poses.nodes[row]
            if row < held:
                graph.add(self._variables.prior(node.id, poses.matrices[row], HELD_SIGMA))
            elif poses.before[row] < 0 and poses.frames[node.session] == node.session:
                graph.add(self._variables.prior(node.id, poses.matrices[row]))
        if joined:
            nodes = [poses.nodes[row] for row in joined]
            previous = [poses.nodes[poses.before[row]] for row in joined]
            motions = se3.inverse(np.stack([x.T_odom_cam for x in previous])) @ np.stack([x.T_odom_cam for x in nodes])
            covariances = white_covariances(nodes, motions, self._drift, self._share)
            for before, node, motion, covariance in zip(previous, nodes, motions, covariances, strict=True):
                adjusted = self._adjustments.motion(before.id, node)
                if adjusted is not None:
                    motion = adjusted[0]
                    covariance = covariance if adjusted[1] is None else adjusted[1]
                graph.add(self._variables.odometry(before.id, node, motion, covariance))
        for key in loops:
            if key in self._loops and max(poses.rows[number] for number in key) >= held:
                graph.add(self._variables.loop(self._adjustments.constraint(self._loops[key])))
        return graph

    def _values(self, rows: Iterable[int]) -> gtsam.Values:
        """Return the present poses of these rows."""
        values = gtsam.Values()
        for row in rows:
            values.insert(self._poses.nodes[row].id, self._variables.value(self._poses.matrices[row]))
        return values
