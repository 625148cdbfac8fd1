"""What the pose graph takes and gives, and what its two solvers have in common; free of GTSAM."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from seamark.backend.errors import BackendInputError

if TYPE_CHECKING:
    from seamark.backend.adjustment import Adjustment

Matrix = NDArray[np.float64]
Key = tuple[int, int]  # query and match, which name a loop


@dataclass(frozen=True, eq=False)
class Span:
    """What a motion is made of where the keyframes on its way have gone.

    ``steps`` motions, which turned by ``angle`` and went ``length`` in all; ``drift`` (6, 6) is the covariance that
    they have beyond the odometry's own, in the later keyframe's frame, rotation first.
    """

    steps: int
    angle: float
    length: float
    drift: Matrix


@dataclass(frozen=True, eq=False)
class Node:
    """A keyframe as the graph sees it.

    ``T_odom_cam`` (4, 4) is its odometry pose, ``covariance`` (6, 6) that of the motion since the previous keyframe.
    ``previous_id`` None starts a session. ``metric`` False: the session's scale is arbitrary and may drift. ``span``
    None: no keyframe between it and the previous one has gone.
    """

    id: int
    session: int
    previous_id: int | None
    T_odom_cam: Matrix
    covariance: Matrix
    metric: bool = True
    span: Span | None = None


@dataclass(frozen=True, eq=False)
class Constraint:
    """A loop as the graph sees it.

    ``T_match_query`` (4, 4) has its translation in the match's units, ``scale`` is match units per query unit,
    ``covariance`` (6, 6) is in the query's frame, rotation first, ``scale_sigma`` of log scale.
    """

    query_id: int
    match_id: int
    T_match_query: Matrix
    covariance: Matrix
    scale: float = 1.0
    scale_sigma: float = 1e-3

    @property
    def key(self) -> Key:
        """The pair of keyframes, which names the loop."""
        return self.query_id, self.match_id

    @property
    def name(self) -> str:
        """The loop in words."""
        return f"loop {self.query_id} to {self.match_id}"


@dataclass(frozen=True, eq=False)
class Estimate:
    """All poses of the graph at one revision; arrays as in :class:`~seamark.backend.types.MapSnapshot`."""

    revision: int
    keyframe_ids: NDArray[np.int64]
    components: NDArray[np.int64]
    T_map_cam: Matrix
    scales: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Graph:
    """A graph that was solved before: ``estimate`` has the poses of all nodes."""

    nodes: Sequence[Node]
    loops: Sequence[Constraint]
    estimate: Estimate
    adjustments: "Sequence[Adjustment]" = ()


class Solver(Protocol):
    """What :class:`PoseGraph` (here) and :class:`SolverProcess` (in a child process) both offer."""

    def add_keyframe(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is malformed."""

    def restore(self, graph: Graph, held: bool = False) -> None:
        """Take in a graph that was solved before, with the poses of all nodes, and solve nothing.

        With ``held`` these poses stay for good: what comes later is fitted to them.
        """

    def exchange(self, graph: Graph) -> None:
        """Take in another graph, as ``restore`` does, in place of all that was told before."""

    def add_loop(self, constraint: Constraint) -> None:
        """Commit a loop; it acts at the next ``optimise``."""

    def remove_loop(self, query_id: int, match_id: int) -> None:
        """Withdraw a loop; it ceases to act at the next ``optimise``."""

    def request(self) -> None:
        """Ask for a solution with all loops so far, to be collected later."""

    def collect(self, wait_s: float = 0.0) -> Estimate | None:
        """Return the solution that was requested; None when there is none yet, however long one waits at most."""

    def optimise(self, thorough: bool = False) -> Estimate:
        """Return the poses with all loops so far; ``thorough`` iterates from scratch to convergence."""

    def weights(self) -> dict[Key, float]:
        """Return the weight (0..1) that the robust kernel leaves each loop."""

    def covariances(self, keyframe_ids: Sequence[int]) -> Matrix:
        """Return the marginal covariances (K, 6, 6) of poses, each in its keyframe's frame, rotation first."""

    def close(self) -> None:
        """Release what the solver holds."""


def check_node(node: Node) -> None:
    """Raise BackendInputError unless the node's numbers are finite and its pose is rigid.

    A NaN would spread through the whole solution without a word (Levenberg-Marquardt returns it silently).
    """
    _check_pose(f"keyframe {node.id}", node.T_odom_cam)
    _check_covariance(f"keyframe {node.id}", node.covariance)


def check_nodes(nodes: Sequence[Node]) -> None:
    """Do what ``check_node`` does for many nodes at once; of those that are malformed the first is named."""
    if nodes and not _all_sound([x.T_odom_cam for x in nodes], [x.covariance for x in nodes]):
        for node in nodes:
            check_node(node)


def _all_sound(poses: Sequence[Matrix], covariances_of: Sequence[Matrix]) -> bool:
    try:
        T, covariances = np.stack(poses), np.stack(covariances_of)
    except ValueError:  # shapes that differ
        return False
    if T.shape[1:] != (4, 4) or covariances.shape[1:] != (6, 6):
        return False
    if not (np.isfinite(T).all() and np.isfinite(covariances).all()):
        return False
    R = T[:, :3, :3]
    rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() <= 1e-3 and (np.linalg.det(R) >= 0).all()
    return bool(rigid and (np.diagonal(covariances, axis1=1, axis2=2) >= 0).all())


def check_constraints(constraints: Sequence[Constraint]) -> None:
    """Do what ``check_constraint`` does for many loops at once; of those that are malformed the first is named."""
    if not constraints:
        return
    numbers = np.array([(x.scale, x.scale_sigma) for x in constraints])
    sound = bool(np.isfinite(numbers).all() and (numbers > 0).all())
    sound = sound and all(x.query_id != x.match_id for x in constraints)
    if not sound or not _all_sound([x.T_match_query for x in constraints], [x.covariance for x in constraints]):
        for constraint in constraints:
            check_constraint(constraint)


def check_constraint(constraint: Constraint) -> None:
    """Raise BackendInputError unless the loop's numbers are finite, its pose rigid and its scale positive."""
    name = constraint.name
    _check_pose(name, constraint.T_match_query)
    _check_covariance(name, constraint.covariance)
    numbers = (constraint.scale, constraint.scale_sigma)
    if not all(np.isfinite(numbers)) or min(numbers) <= 0:
        raise BackendInputError(f"{name} has scale {constraint.scale} +- {constraint.scale_sigma}")
    if constraint.query_id == constraint.match_id:
        raise BackendInputError(f"{name} joins a keyframe with itself")


def _check_pose(name: str, T: Matrix) -> None:
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise BackendInputError(f"{name} has a pose that is no finite 4 x 4 matrix: {T.tolist()}")
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0:
        raise BackendInputError(f"{name} has a pose whose rotation is none: {T[:3, :3].tolist()}")


def _check_covariance(name: str, covariance: Matrix) -> None:
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
        raise BackendInputError(f"{name} has a covariance that is none: {covariance.tolist()}")
