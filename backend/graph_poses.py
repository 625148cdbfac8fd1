"""Where the keyframes of a pose graph are, and in whose frame; free of GTSAM."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from seamark.backend.consistency import similarity
from seamark.backend.errors import BackendInputError
from seamark.backend.graph_types import Constraint, Estimate, Key, Node, check_nodes
from seamark.frontend import se3

Matrix = NDArray[np.float64]
_FIRST_ROWS = 1024


class GraphPoses:
    """Keyframes in the order in which they came, one row each, with their present poses.

    Each session starts as a component of its own in its odometry's frame. A loop between sessions joins their
    components: the older session's frame holds, the younger one is moved.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.rows: dict[int, int] = {}
        self.before: list[int] = []  # row of the predecessor, -1 where a session starts
        self.frames: dict[int, int] = {}  # session -> session in whose frame its poses are
        self.matrices = np.tile(np.eye(4), (_FIRST_ROWS, 1, 1))  # [sR t; 0 1] from keyframe to map; spare rows at end
        self._first_rows: dict[int, int] = {}  # session -> row of its first and of its last keyframe
        self._last_rows: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self.nodes)

    def add(self, node: Node) -> None:
        """Append a keyframe, which hangs on its predecessor; raises BackendInputError when it is malformed or known."""
        self.extend([node])

    def extend(self, nodes: Sequence[Node]) -> None:
        """Append keyframes one after the other; raises BackendInputError at the first that is malformed or known."""
        check_nodes(nodes)
        for node in nodes:
            self._append(node)

    def _append(self, node: Node) -> None:
        if node.id in self.rows:
            raise BackendInputError(f"keyframe {node.id} was given twice")
        before = self._last_rows.get(node.session, -1)
        if node.previous_id is not None:
            before = self.rows.get(node.previous_id, -1)
            if before < 0 or self.nodes[before].session != node.session:
                raise BackendInputError(f"keyframe {node.id} follows {node.previous_id}, which is not in its session")
        row = self.rows[node.id] = len(self.nodes)
        self.nodes.append(node)
        self.before.append(before)
        self._first_rows.setdefault(node.session, row)
        self._last_rows[node.session] = row
        self.frames.setdefault(node.session, node.session)
        if row == len(self.matrices):
            self.matrices = np.concatenate([self.matrices, self.matrices])
        if before < 0:
            self.matrices[row] = node.T_odom_cam
        else:
            motion = se3.inverse(self.nodes[before].T_odom_cam) @ node.T_odom_cam
            self.matrices[row] = self.matrices[before] @ motion

    def take(self, estimate: Estimate) -> None:
        """Put keyframes where an earlier solution has them."""
        poses = estimate.T_map_cam.copy()
        poses[:, :3, :3] *= estimate.scales[:, None, None]
        rows = [self.rows[number] for number in estimate.keyframe_ids.tolist()]
        self.matrices[rows] = poses
        for row, component in zip(rows, estimate.components.tolist(), strict=True):
            self.frames[self.nodes[row].session] = component

    def by_id(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all ids (N,), ascending, and their rows (N,)."""
        ids = np.array([node.id for node in self.nodes], np.int64)
        order = np.argsort(ids, kind="stable")
        return ids[order], order

    def estimate(self, revision: int, scaled: bool) -> Estimate:
        """Return all poses by ascending id; without ``scaled`` every scale is 1, exactly."""
        ids, order = self.by_id()
        poses = self.matrices[order]
        scales = np.cbrt(np.linalg.det(poses[:, :3, :3])) if scaled else np.ones(len(ids))
        T_map_cam = poses.copy()
        T_map_cam[:, :3, :3] /= scales[:, None, None]
        components = np.array([self.frames[node.session] for node in self.nodes], np.int64)[order]
        return Estimate(revision, ids, components, T_map_cam, scales)

    def settle(self, loops: Mapping[Key, Constraint]) -> bool:
        """Move sessions into the frame of their component's oldest session; return whether any frame has changed."""
        wanted = self._components(loops)
        changed = False
        for root in sorted(set(wanted.values())):
            if self.frames[root] != root:  # a withdrawn loop has set this component free
                first = self._first_rows[root]
                G = self.nodes[first].T_odom_cam @ np.linalg.inv(self.matrices[first])
                self._move(self.frames[root], root, G, wanted)
                changed = True
        pending = len(wanted) > 1
        while pending:
            pending = False
            for (query_id, match_id), constraint in sorted(loops.items(), key=lambda item: item[0]):
                query, match = self.rows[query_id], self.rows[match_id]
                a, b = self.nodes[match].session, self.nodes[query].session
                root = wanted[a]
                if (self.frames[a] == root) == (self.frames[b] == root):
                    continue
                S = similarity(constraint)
                if self.frames[a] == root:
                    G = self.matrices[match] @ S @ np.linalg.inv(self.matrices[query])
                    self._move(self.frames[b], root, G, wanted)
                else:
                    G = self.matrices[query] @ np.linalg.inv(S) @ np.linalg.inv(self.matrices[match])
                    self._move(self.frames[a], root, G, wanted)
                changed = pending = True
        return changed

    def _move(self, old: int, new: int, G: NDArray[np.floating], wanted: dict[int, int]) -> None:
        """Map all sessions that are in frame ``old`` and belong to component ``new`` by G into frame ``new``."""
        moved = {session for session, frame in self.frames.items() if frame == old and wanted[session] == new}
        rows = np.array([row for row, node in enumerate(self.nodes) if node.session in moved], np.int64)
        self.matrices[rows] = G @ self.matrices[rows]
        self.frames.update(dict.fromkeys(moved, new))

    def _components(self, loops: Mapping[Key, Constraint]) -> dict[int, int]:
        """Return for each session the oldest one that loops join it with."""
        roots = {session: session for session in self.frames}
        if len(roots) < 2:
            return roots

        def root_of(session: int) -> int:
            while roots[session] != session:
                session = roots[session]
            return session

        for key in loops:
            a, b = (root_of(self.nodes[self.rows[keyframe_id]].session) for keyframe_id in key)
            roots[max(a, b)] = min(a, b)
        return {session: root_of(session) for session in roots}
