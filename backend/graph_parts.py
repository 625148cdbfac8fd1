"""A pose graph file as the back end sees it: odometry between consecutive nodes, and all else as loop candidates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import adjoint_stack
from seamark.backend.g2o import GraphFile
from seamark.backend.graph_types import Constraint, Node
from seamark.frontend import se3

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GraphParts:
    """Nodes in order, each hanging on its predecessor by odometry, and the loop candidates.

    Where the odometry between consecutive nodes is missing a new part (session) starts. ``loops`` come in the order of
    their later node, then of the file; ``ends`` (L, 2) are the file's own ``from`` and ``to``. ``duplicates`` (D, 2)
    are further edges between two nodes that an earlier line has joined: the first one counts.
    """

    planar: bool
    nodes: tuple[Node, ...]
    loops: tuple[Constraint, ...]
    ends: NDArray[np.int64]
    duplicates: NDArray[np.int64]


def split_graph(graph: GraphFile) -> GraphParts:
    """Tell odometry from loop candidates: an edge between nodes whose ids follow each other is odometry."""
    order = np.searchsorted(graph.node_ids, np.stack([graph.from_ids, graph.to_ids], axis=1))
    early, late = order.min(axis=1), order.max(axis=1)
    T_early_late, covariances = _forward(graph, order[:, 0] > order[:, 1])
    _, first = np.unique(late * len(graph.node_ids) + early, return_index=True)
    counts = np.zeros(len(early), bool)
    counts[first] = True
    odometry = np.flatnonzero(counts & (late == early + 1))
    loops = np.flatnonzero(counts & (late != early + 1))
    loops = loops[np.lexsort((loops, late[loops]))]
    ends = np.stack([graph.from_ids, graph.to_ids], axis=1)
    return GraphParts(
        planar=graph.planar,
        nodes=_nodes(graph, late[odometry], T_early_late[odometry], covariances[odometry]),
        loops=tuple(
            Constraint(int(graph.node_ids[late[k]]), int(graph.node_ids[early[k]]), T_early_late[k], covariances[k])
            for k in loops.tolist()
        ),
        ends=ends[loops],
        duplicates=ends[~counts],
    )


def _forward(graph: GraphFile, backward: NDArray[np.bool_]) -> tuple[Matrix, Matrix]:
    """Return the motions from the later node to the earlier one, and their covariances in the later one's frame."""
    T, covariances = graph.T_from_to.copy(), graph.covariances.copy()
    Ad = adjoint_stack(T[backward])
    T[backward] = se3.inverse(T[backward])
    covariances[backward] = Ad @ covariances[backward] @ np.swapaxes(Ad, 1, 2)
    return T, covariances


def _nodes(graph: GraphFile, late: NDArray[np.int64], T: Matrix, covariances: Matrix) -> tuple[Node, ...]:
    """Chain the odometry; each part starts at its first node's pose in the file, or at the origin."""
    N = len(graph.node_ids)
    motion_of = np.full(N, -1)
    motion_of[late] = np.arange(len(late))
    nodes: list[Node] = []
    pose, session = np.eye(4), -1
    nothing = np.zeros((6, 6))
    ids = graph.node_ids.tolist()
    for k, motion in enumerate(motion_of.tolist()):
        if motion < 0:
            session += 1
            pose = np.eye(4) if np.isnan(graph.T_vertex[k, 0, 0]) else graph.T_vertex[k]
            nodes.append(Node(ids[k], session, None, pose, nothing))
            continue
        pose = pose @ T[motion]
        if k % 100 == 0:
            pose = se3.orthonormalise(pose)
        nodes.append(Node(ids[k], session, ids[k - 1], pose, covariances[motion]))
    return tuple(nodes)
