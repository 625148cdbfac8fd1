"""Which loops agree with odometry and with each other.

Pairwise consistency after Mangelsen et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot
Map Merging" (ICRA 2018): two loops and the odometry between their ends make a cycle, whose error must be explained by
the covariances; of all loops the largest set in which every pair agrees is kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains, adjoint_stack
from seamark.backend.graph_types import Constraint
from seamark.frontend import se3

Matrix = NDArray[np.float64]


def similarity(constraint: Constraint) -> Matrix:
    """Return the loop as the (4, 4) matrix [sR t; 0 1] that maps the query's frame and units into the match's."""
    S = constraint.T_match_query.copy()
    S[:3, :3] *= constraint.scale
    return S


def gate_chi2(constraint: Constraint, chains: OdometryChains) -> float:
    """Return chi squared (6 dof) of a loop within one session against the odometry between its ends."""
    return float(odometry_chi2([constraint], chains)[0])


@dataclass(frozen=True, eq=False)
class Cycles:
    """K cycles of loops and odometry.

    ``error`` (K, 6) rotation first, with covariances ``odometry`` and ``loops`` (K, 6, 6) of what it is made of;
    ``log_scale`` (K,) with ``scale_variance`` (K,); ``steps`` (K, 2) of odometry between the queries and the matches.
    """

    error: Matrix
    odometry: Matrix
    loops: Matrix
    log_scale: NDArray[np.float64]
    scale_variance: NDArray[np.float64]
    steps: NDArray[np.int64]

    def chi2(self) -> NDArray[np.float64]:
        """Return chi squared (K,) of the errors; infinite where it is no number."""
        return chi_squared(self.error, self.odometry + self.loops, self.log_scale, self.scale_variance)


def odometry_chi2(loops: Sequence[Constraint], chains: OdometryChains) -> NDArray[np.float64]:
    """Return chi squared (K,) (6 dof) of loops, each within one session, against the odometry between their ends."""
    return odometry_cycles(loops, chains).chi2()


def odometry_cycles(loops: Sequence[Constraint], chains: OdometryChains) -> Cycles:
    """Return the cycles that loops, each within one session, close with the odometry between their ends."""
    odometry = chains.relative([loop.query_id for loop in loops], [loop.match_id for loop in loops])
    E = _stack(loops) @ odometry.T_a_b  # ends in the match's frame, where the odometry's covariance is
    Ad = adjoint_stack(np.linalg.inv(odometry.T_a_b))
    moved = Ad @ _covariances(loops) @ np.swapaxes(Ad, 1, 2)
    steps = np.stack([odometry.keyframes, odometry.keyframes], axis=1)
    scale_variance = odometry.scale_variance + _scale_variances(loops)
    return _cycles(E, odometry.covariance, moved, scale_variance, steps)


def pair_chi2(
    loops: Sequence[Constraint], others: Sequence[Constraint], chains: OdometryChains
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return chi squared (K,) of the cycles of K pairs of loops (see ``pair_cycles``) and their steps (K, 2)."""
    cycles = pair_cycles(loops, others, chains)
    return cycles.chi2(), cycles.steps


def pair_cycles(loops: Sequence[Constraint], others: Sequence[Constraint], chains: OdometryChains) -> Cycles:
    """Return the cycles that K pairs of loops close; both of a pair must join the same two sessions in one order."""
    S1, S2 = _stack(loops), _stack(others)
    queries = chains.relative([loop.query_id for loop in loops], [other.query_id for other in others])
    matches = chains.relative([other.match_id for other in others], [loop.match_id for loop in loops])
    # match1 <- query1 <- query2 <- match2 <- match1; errors are moved to the end, the frame of match1.
    end_query2 = np.linalg.inv(matches.T_a_b) @ S2
    Ad2 = adjoint_stack(end_query2)
    Ad1 = adjoint_stack(end_query2 @ np.linalg.inv(queries.T_a_b))
    E = S1 @ queries.T_a_b @ np.linalg.inv(S2) @ matches.T_a_b
    odometry = matches.covariance + Ad2 @ queries.covariance @ np.swapaxes(Ad2, 1, 2)
    own = Ad2 @ _covariances(others) @ np.swapaxes(Ad2, 1, 2) + Ad1 @ _covariances(loops) @ np.swapaxes(Ad1, 1, 2)
    scale_variance = queries.scale_variance + matches.scale_variance
    scale_variance = scale_variance + _scale_variances(loops) + _scale_variances(others)
    steps = np.stack([queries.keyframes, matches.keyframes], axis=1)
    return _cycles(E, odometry, own, scale_variance, steps)


def consistent_matrix(loops: Sequence[Constraint], chains: OdometryChains, chi2: float) -> NDArray[np.bool_]:
    """Return which pairs (N, N) agree; loops of other session pairs say nothing of each other and agree."""
    sessions = np.array([(chains.node(x.query_id).session, chains.node(x.match_id).session) for x in loops])
    agree = np.ones((len(loops), len(loops)), bool)
    rows, columns = np.triu_indices(len(loops), 1)
    same = (sessions[rows] == sessions[columns]).all(axis=1)
    rows, columns = rows[same], columns[same]
    if len(rows):
        values, _ = pair_chi2([loops[i] for i in rows], [loops[j] for j in columns], chains)
        agree[rows, columns] = agree[columns, rows] = values <= chi2
    return agree


def greedy_clique(agree: NDArray[np.bool_], weights: NDArray[np.float64], starts: int) -> NDArray[np.bool_]:
    """Return the members (N,) of a heavy clique of the graph ``agree`` (N, N), weighted by ``weights`` (N,).

    Greedy from the ``starts`` nodes with most agreeing weight: of the nodes that agree with all members, the one with
    most weight among them joins. Deterministic; ties go to the lower index. Nodes that agree with all others are
    members of every such clique and need no search.
    """
    torn = np.flatnonzero(~agree.all(axis=1))
    if 0 < len(torn) < len(agree):
        best = np.ones(len(agree), bool)
        best[torn] = greedy_clique(agree[np.ix_(torn, torn)], weights[torn], starts)
        return best
    if len(torn) == 0:
        return np.ones(len(agree), bool)
    linked = agree & ~np.eye(len(agree), dtype=bool)
    degree = linked @ weights + weights
    best, best_weight = np.zeros(len(agree), bool), -1.0
    for start in np.argsort(-degree, kind="stable")[:starts]:
        members = np.zeros(len(agree), bool)
        members[start] = True
        open_nodes = linked[start].copy()
        while open_nodes.any():
            nodes = np.flatnonzero(open_nodes)
            inner = linked[np.ix_(nodes, nodes)] @ weights[nodes] + weights[nodes]
            chosen = nodes[int(np.argmax(inner))]
            members[chosen] = True
            open_nodes &= linked[chosen]
        weight = float(weights[members].sum())
        if weight > best_weight + 1e-9:
            best, best_weight = members, weight
    return best


def chi_squared(
    error: Matrix, covariance: Matrix, log_scale: NDArray[np.float64], scale_variance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return chi squared (K,) of errors (K, 6) and of log scales (K,); infinite where it is no number."""
    weighted = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    values = (error * weighted).sum(axis=1) + log_scale**2 / scale_variance
    return np.where(np.isfinite(values), values, np.inf)


def cycle_error(E: NDArray[np.floating]) -> tuple[Matrix, NDArray[np.float64]]:
    """Return the errors (K, 6), rotation first, and the log scales (K,) of cycles E (K, 4, 4) = [sR t; 0 1]."""
    scale = np.cbrt(np.linalg.det(E[:, :3, :3]))
    return np.concatenate([log_rotations(E[:, :3, :3] / scale[:, None, None]), E[:, :3, 3]], axis=1), np.log(scale)


def log_rotations(R: Matrix) -> Matrix:
    """Return the rotation vectors (K, 3) of rotations (K, 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    angles = se3.rotation_angle(R)
    axes = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    out = axes / np.sinc(angles / np.pi)[:, None]  # numpy's sinc has pi inside
    for k in np.flatnonzero(angles > 3.0):  # near half a turn the axis is no longer in the skew part
        out[k] = se3.log_rotation(R[k])
    return out


def _cycles(
    E: NDArray[np.floating],
    odometry: Matrix,
    loops: Matrix,
    scale_variance: NDArray[np.float64],
    steps: NDArray[np.int64],
) -> Cycles:
    error, log_scale = cycle_error(E)
    return Cycles(error, odometry, loops, log_scale, scale_variance, steps)


def _stack(loops: Sequence[Constraint]) -> Matrix:
    S = np.stack([loop.T_match_query for loop in loops])
    S[:, :3, :3] *= np.array([loop.scale for loop in loops])[:, None, None]
    return S


def _covariances(loops: Sequence[Constraint]) -> Matrix:
    return np.stack([loop.covariance for loop in loops])


def _scale_variances(loops: Sequence[Constraint]) -> NDArray[np.float64]:
    return np.array([loop.scale_sigma**2 for loop in loops])
