"""What holds the keyframes of a bundle adjustment together beside landmarks: odometry and loops."""

from collections.abc import Mapping, Sequence
from typing import Final

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains, adjoint_stack, white_covariances
from seamark.backend.config import DriftConfig
from seamark.backend.drift import drift_share
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.types import Loop
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]
Link = tuple[int, int, Matrix, Matrix]  # two keyframes, T_first_second and its covariance

STRETCH: Final = 10  # loops of so many neighbouring keyframes close the same way
MIDDLE_CHI2: Final = 5.348  # the median of chi squared with 6 degrees of freedom
LEAST_SHARE: Final = 1 / 64  # of the variance that odometry allows for


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


def reweighed(links: Sequence[Link], T_solved: Mapping[int, Matrix], warp: float, depth: float) -> list[Link]:
    """Return what odometry says, as surely as a solution that hardly heard it bears out (``T_solved`` T_map_cam).

    Odometry allows for more than it mostly errs by, and the middle of what it differs by from the solution, which errs
    too, says how much more at most; single motions that are worse are left to a robust kernel. But odometry took the
    depths at their word: where these, ``depth`` in the median, are warped by the share ``warp``, it took parallax for
    turns and motions for longer than they were.
    """
    chi2 = []
    for first, second, T, covariance in links:
        E = se3.inverse(T) @ se3.inverse(T_solved[first]) @ T_solved[second]
        error = np.concatenate([se3.log_rotation(E[:3, :3]), E[:3, 3]])
        chi2.append(float(error @ np.linalg.solve(covariance, error)))
    share = float(np.clip(np.median(chi2) / MIDDLE_CHI2, LEAST_SHARE, 1.0))
    out = []
    for first, second, T, covariance in links:
        bent = warp * float(np.linalg.norm(T[:3, 3]))
        out.append((first, second, T, share * covariance + np.diag(np.repeat([(bent / depth) ** 2, bent**2], 3))))
    return out


def motion_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframes: Mapping[int, Keyframe]
) -> tuple[NDArray[np.int64], Matrix]:
    """Return of each keyframe (by ascending id) the one before it in its session (N,), and the covariance (N, 6, 6) of
    the motion since, in its frame; -1 and NaN at the first of a session, NaN where the system does not say.
    """
    rows = {number: row for row, number in enumerate(sorted(keyframes))}
    previous_ids, covariances = np.full(len(rows), -1, np.int64), np.full((len(rows), 6, 6), np.nan)
    landmarks = gtsam.Ordering()
    for key in values.keys():  # noqa: SIM118 (no mapping)
        if gtsam.Symbol(key).chr() == ord("l"):
            landmarks.push_back(key)
    try:
        _, reduced = graph.linearize(values).eliminatePartialMultifrontal(landmarks)
        marginals = gtsam.Marginals(reduced, values)
    except RuntimeError:
        marginals = None
    for before, number in followers(keyframes):
        previous_ids[rows[number]] = before
        if marginals is None:
            continue
        keys = [X(before), X(number)]
        joint = marginals.jointMarginalCovariance(keys)
        a, b = keys
        blocks = np.block([[joint.at(a, a), joint.at(a, b)], [joint.at(b, a), joint.at(b, b)]])
        motion = values.atPose3(a).between(values.atPose3(b)).matrix()
        J = np.hstack([-adjoint_stack(se3.inverse(motion)[None])[0], np.eye(6)])  # of the motion, in the later frame
        C = J @ blocks @ J.T
        covariances[rows[number]] = 0.5 * (C + C.T)
    return previous_ids, covariances


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
