"""Which loops agree with odometry and with each other.

Pairwise consistency after Mangelsen et al., "Pairwise Consistent Measurement Set Maximization for Robust Multi-robot
Map Merging" (ICRA 2018): two loops and the odometry between their ends make a cycle, whose error must be explained by
the covariances; of all loops the largest set in which every pair agrees is kept.
"""

from collections.abc import Sequence

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
    odometry = chains.relative([constraint.query_id], [constraint.match_id])
    S = similarity(constraint)[None]
    E = S @ odometry.T_a_b  # ends in the match's frame, where the odometry's covariance is
    Ad = adjoint_stack(np.linalg.inv(odometry.T_a_b))
    covariance = odometry.covariance + Ad @ constraint.covariance @ np.swapaxes(Ad, 1, 2)
    scale_variance = odometry.scale_variance + constraint.scale_sigma**2
    return float(_chi2(E, covariance, scale_variance)[0])


def pair_chi2(
    loop: Constraint, others: Sequence[Constraint], chains: OdometryChains
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return chi squared (K,) of the cycles that ``loop`` closes with each other loop, and the odometry steps in them.

    The other loops must join the same two sessions in the same order. The steps (K, 2) are between the two queries and
    between the two matches.
    """
    K = len(others)
    S1 = np.broadcast_to(similarity(loop), (K, 4, 4))
    S2_inverse = np.linalg.inv(np.stack([similarity(other) for other in others]))
    queries = chains.relative([loop.query_id] * K, [other.query_id for other in others])
    matches = chains.relative([other.match_id for other in others], [loop.match_id] * K)
    # match1 <- query1 <- query2 <- match2 <- match1; errors are moved to the end, the frame of match1.
    end_match2 = np.linalg.inv(matches.T_a_b)
    end_query2 = end_match2 @ np.linalg.inv(S2_inverse)
    end_query1 = end_query2 @ np.linalg.inv(queries.T_a_b)
    E = S1 @ queries.T_a_b @ S2_inverse @ matches.T_a_b
    covariance = matches.covariance.copy()
    covariances2 = np.stack([other.covariance for other in others])
    for frame, part in ((end_query2, queries.covariance + covariances2), (end_query1, loop.covariance[None])):
        Ad = adjoint_stack(frame)
        covariance += Ad @ part @ np.swapaxes(Ad, 1, 2)
    scale_variance = queries.scale_variance + matches.scale_variance + loop.scale_sigma**2
    scale_variance = scale_variance + np.array([other.scale_sigma**2 for other in others])
    steps = np.stack([queries.keyframes, matches.keyframes], axis=1)
    return _chi2(E, covariance, scale_variance), steps


def consistent_matrix(loops: Sequence[Constraint], chains: OdometryChains, chi2: float) -> NDArray[np.bool_]:
    """Return which pairs (N, N) agree; loops of other session pairs say nothing of each other and agree."""
    sessions = [(chains.node(x.query_id).session, chains.node(x.match_id).session) for x in loops]
    agree = np.ones((len(loops), len(loops)), bool)
    for i in range(len(loops)):
        same = [j for j in range(i + 1, len(loops)) if sessions[j] == sessions[i]]
        if same:
            values, _ = pair_chi2(loops[i], [loops[j] for j in same], chains)
            agree[i, same] = agree[same, i] = values <= chi2
    return agree


def greedy_clique(agree: NDArray[np.bool_], weights: NDArray[np.float64], starts: int) -> NDArray[np.bool_]:
    """Return the members (N,) of a heavy clique of the graph ``agree`` (N, N), weighted by ``weights`` (N,).

    Greedy from the ``starts`` nodes with most agreeing weight: of the nodes that agree with all members, the one with
    most weight among them joins. Deterministic; ties go to the lower index.
    """
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


def _chi2(E: NDArray[np.floating], covariance: Matrix, scale_variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return chi squared (K,) of cycles E (K, 4, 4) = [sR t; 0 1] against the identity, to first order."""
    scale = np.cbrt(np.linalg.det(E[:, :3, :3]))
    rotations = np.stack([se3.log_rotation(R) for R in E[:, :3, :3] / scale[:, None, None]])
    error = np.concatenate([rotations, E[:, :3, 3]], axis=1)
    weighted = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    values = (error * weighted).sum(axis=1) + np.log(scale) ** 2 / scale_variance
    return np.where(np.isfinite(values), values, np.inf)
