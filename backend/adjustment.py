"""What a full adjustment knows beyond odometry and loops, for the pose graphs that come after it; free of GTSAM.

An adjustment is kept as the poses that it found and how sure it was of each motion. While all loops that it rests on
are accepted, a pose graph takes what is between its keyframes from it, in place of what odometry and loops had measured
there: these measurements are in it already and must not pull a second time. When one of those loops is withdrawn,
the measurements count again as they were.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import adjoint_stack
from seamark.backend.contraction import Contraction
from seamark.backend.graph_types import Constraint, Key, Node
from seamark.frontend import se3

Matrix = NDArray[np.float64]
LEAST_WEIGHT: Final = 1e-3


@dataclass(frozen=True, eq=False)
class AdjustedPose:
    """Where an adjustment has a keyframe: ``T_map_cam`` (4, 4), ``scale`` map units per unit of its landmarks.

    ``covariance`` (6, 6) is of its motion since keyframe ``previous_id``, in its frame and units, rotation first; None
    where the adjustment is as sure of that as odometry is.
    """

    T_map_cam: Matrix
    scale: float
    previous_id: int | None
    covariance: Matrix | None

    @property
    def similarity(self) -> Matrix:
        """[sR t; 0 1] from the keyframe to the map."""
        S = self.T_map_cam.copy()
        S[:3, :3] *= self.scale
        return S


@dataclass(frozen=True, eq=False)
class Adjustment:
    """One adjustment of one component: its keyframes, and the loops that it rests on with the weight (0..1) of each."""

    id: int
    poses: Mapping[int, AdjustedPose]
    loops: Mapping[Key, float]

    def stands(self, accepted: Container[Key]) -> bool:
        """Return whether all loops that it rests on are among those accepted."""
        return all(key in accepted for key in self.loops)

    def motion(self, first: int, second: int) -> Matrix:
        """Return [sR t; 0 1] from the second keyframe to the first."""
        return np.asarray(np.linalg.inv(self.poses[first].similarity) @ self.poses[second].similarity, np.float64)

    def contracted(self, graph: Contraction) -> "Adjustment | None":
        """Return what is left of it when keyframes have gone, None where nothing is.

        Motions on whose way keyframes have gone are composed. It rests on what has become of its loops.
        """
        kept = {node.id: node for node in graph.nodes if node.id in self.poses}
        if len(kept) < 2:
            return None
        poses = {number: self._relinked(number, node, graph) for number, node in kept.items()}
        loops = {key: weight for key, weight in self.loops.items() if key in graph.loops}
        for key, own in graph.composed.items():
            if own.origin in self.loops and kept.keys() >= set(key):
                loops[key] = self.loops[own.origin]
            else:
                loops.pop(key, None)
        return Adjustment(self.id, poses, loops)

    def _relinked(self, number: int, node: Node, graph: Contraction) -> AdjustedPose:
        pose = self.poses[number]
        if pose.previous_id is None or pose.previous_id not in graph.gone:
            return pose
        covariance, link = np.zeros((6, 6)), number
        while link != node.previous_id:
            step = self.poses.get(link)
            if step is None or step.previous_id is None or step.covariance is None:
                return replace(pose, previous_id=node.previous_id, covariance=None)
            Ad = adjoint_stack(self.motion(number, link)[None])[0]
            covariance += Ad @ step.covariance @ Ad.T
            link = step.previous_id
        return replace(pose, previous_id=node.previous_id, covariance=covariance)


class Adjustments:
    """The adjustments of a map, and which of them stand."""

    def __init__(self, known: Sequence[Adjustment] = ()) -> None:
        self._known = tuple(known)
        self._standing: frozenset[int] = frozenset()
        self._of: dict[int, Adjustment] = {}

    def update(self, accepted: Container[Key]) -> bool:
        """Say which loops are accepted; return whether an adjustment stands that did not, or falls that stood."""
        standing = frozenset(one.id for one in self._known if one.stands(accepted))
        if standing == self._standing:
            return False
        self._standing = standing
        self._of = {number: one for one in self._known if one.id in standing for number in one.poses}
        return True

    def motion(self, previous_id: int, node: Node) -> tuple[Matrix, Matrix | None] | None:
        """Return [sR t; 0 1] from a keyframe to its predecessor and its covariance, None where odometry must say it.

        The covariance (6, 6) is None where it is that of odometry.
        """
        mine = self._common(previous_id, node.id)
        if mine is None:
            return None
        pose = mine.poses[node.id]
        return mine.motion(previous_id, node.id), pose.covariance if pose.previous_id == previous_id else None

    def constraint(self, loop: Constraint) -> Constraint:
        """Return what a loop still has to say: nothing new where an adjustment rests on it."""
        mine = self._common(*loop.key)
        if mine is None or loop.key not in mine.loops:
            return loop
        S, weight = mine.motion(loop.match_id, loop.query_id), max(mine.loops[loop.key], LEAST_WEIGHT)
        scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
        T = se3.orthonormalise(se3.make(S[:3, :3] / scale, S[:3, 3]))
        sigma = loop.scale_sigma / float(np.sqrt(weight))
        return Constraint(*loop.key, T, loop.covariance / weight, scale, sigma)

    def _common(self, one: int, other: int) -> Adjustment | None:
        mine = self._of.get(one)
        return mine if mine is not None and mine is self._of.get(other) else None
