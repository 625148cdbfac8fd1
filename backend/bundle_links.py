"""What holds the keyframes of a bundle adjustment together beside landmarks: odometry and loops."""

from collections.abc import Mapping, Sequence
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains, white_covariances
from seamark.backend.config import DriftConfig
from seamark.backend.drift import drift_share
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.types import Loop
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]
Link = tuple[int, int, Matrix, Matrix]  # two keyframes, T_first_second and its covariance

STRETCH: Final = 10  # loops of so many neighbouring keyframes close the same way


def followers(keyframes: Mapping[int, Keyframe]) -> list[tuple[int, int]]:
    """Return the pairs (earlier, later) of keyframes that follow each other in a session."""
    last: dict[int, int] = {}
    pairs = []
    for number in sorted(keyframes):
        session = keyframes[number].session
        if session in last:
            pairs.append((last[session], number))
        last[session] = number
    return pairs


def odometry_links(keyframes: Mapping[int, Keyframe], loops: Sequence[Constraint], drift: DriftConfig) -> list[Link]:
    """Return the motions between followers, trusted as far as the loops bear odometry out."""
    nodes = {number: _node(keyframes[number]) for number in sorted(keyframes)}
    chains = OdometryChains(drift)
    chains.extend(list(nodes.values()))
    share = drift_share(loops, chains, STRETCH)
    links = []
    for before, number in followers(keyframes):
        T = se3.inverse(nodes[before].T_odom_cam) @ nodes[number].T_odom_cam
        covariance = white_covariances([nodes[number]], T[None], drift, share)[0]
        links.append((before, number, T, covariance * (number - before)))  # keyframes between have been forgotten
    return links


def measured(loops: Sequence[Loop]) -> list[tuple[Loop, Matrix, Matrix]]:
    """Return the accepted loops that have a pose, with it and its covariance."""
    found = ((loop, loop.T_match_query, loop.covariance) for loop in loops if loop.accepted)
    return [(loop, T, covariance) for loop, T, covariance in found if T is not None and covariance is not None]


def pose_of(T: Matrix) -> gtsam.Pose3:
    """Return the rigid motion (4, 4) as GTSAM's."""
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])


def _node(keyframe: Keyframe) -> Node:
    assert keyframe.T_odom_cam is not None
    covariance = np.zeros((6, 6)) if keyframe.covariance is None else keyframe.covariance
    return Node(keyframe.id, keyframe.session, None, keyframe.T_odom_cam, covariance)
