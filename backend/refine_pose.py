"""The most probable pose between two cameras from all that their matches say, and an honest covariance of it.

The errors are those of :mod:`seamark.backend.pose_errors`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.pose_errors import Observations, errors, linearise
from seamark.backend.shared_errors import excess_angle, systematic
from seamark.frontend import se3

Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]

STEPS = 12
CONVERGED = 1e-5  # rad, and per depth: a hundredth of a pixel
DEPTH_PAIRS = 10  # matches with both depths from which their noise is measured
DEPTH_OUTLIER = 4.0  # standard deviations
NEAREST = 0.05  # of the median depth: nothing is nearer


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """``T_match_query`` with its ``covariance`` (6, 6) in the query's tangent space, and what it rests on.

    ``without_one``: the deviations of rotation (rad) and translation, in their worst directions, with the match left
    out that holds the pose most. ``inliers`` (M,) of all matches, ``reprojection_px`` their median error,
    ``depth_pairs`` how many inliers have a depth on both sides, ``depth_sigma`` the noise of inverse depth that was
    assumed or measured, ``depth`` the median depth of the inliers.
    """

    T_match_query: Matrix
    covariance: Matrix
    without_one: tuple[float, float]
    inliers: Flags
    reprojection_px: float
    depth_pairs: int
    depth_sigma: float
    depth: float


def refine(T_match_query: Matrix, seen: Observations, config: VerificationConfig) -> RefinedPose | None:
    """Return the pose of least weighed errors near ``T_match_query``; None where too little holds it.

    Gauss-Newton with Cauchy's weights; which matches belong to it is decided anew at each step.
    """
    T = T_match_query
    sigma = depth_sigma(T, seen, errors(T, seen) < config.reprojection_px)
    for _ in range(STEPS):
        inliers = _inliers(T, seen, sigma, config)
        if inliers.sum() < 6:
            return None
        system = linearise(T, seen, inliers, sigma, config)
        information = system.J.T @ system.J
        scaling = _scaling(T, seen, inliers)
        if not _well_conditioned(information, scaling):
            return None
        step = scaling * np.linalg.solve(
            information * np.outer(scaling, scaling), -scaling * (system.J.T @ system.errors)
        )
        T = T @ se3.make(se3.exp_rotation(step[:3]), step[3:])
        sigma = depth_sigma(T, seen, inliers)
        if np.abs(step / scaling).max() < CONVERGED:
            break
    inliers = _inliers(T, seen, sigma, config)
    if inliers.sum() < 6:
        return None
    system = linearise(T, seen, inliers, sigma, config)
    information, scaling = system.J.T @ system.J, _scaling(T, seen, inliers)
    if not _well_conditioned(information, scaling):
        return None
    covariance = scaling[:, None] * np.linalg.inv(information * np.outer(scaling, scaling)) * scaling
    covariance *= system.variance_scale
    depth = float(scaling[3])
    angle = excess_angle(system.variance_scale, system.share, seen.query.fx, config)
    common = np.diag(systematic(T, depth, sigma * depth, angle, config) ** 2)
    both = np.isfinite(seen.X_query).all(axis=1) & np.isfinite(seen.X_match).all(axis=1)
    middle = float(np.median(errors(T, seen)[inliers]))
    covariance = 0.5 * (covariance + covariance.T) + common
    left = worst_deviations(system.without_one(scaling) + common)
    return RefinedPose(T, covariance, left, inliers, middle, int((both & inliers).sum()), sigma, depth)


def worst_deviations(covariances: Matrix) -> tuple[float, float]:
    """Return the standard deviations of rotation (rad) and translation, each in its worst direction, of the worst of
    covariances (L, 6, 6).
    """
    rotation, translation = (
        float(np.sqrt(np.linalg.eigvalsh(covariances[:, part, part])[:, -1].max())) for part in (slice(3), slice(3, 6))
    )
    return rotation, translation


def explained_without_depth(T_match_query: Matrix, seen: Observations, limit_px: float) -> tuple[Flags, Flags]:
    """Return which matches (M,) without a landmark on either side some depth explains, and which have none.

    A pose that a repeated pattern nearby has brought forth leaves what stands farther away unexplained.
    """
    known = np.isfinite(seen.X_query).all(axis=1) | np.isfinite(seen.X_match).all(axis=1)
    without: Flags = np.asarray(~known)
    R, t = T_match_query[:3, :3], T_match_query[:3, 3]
    near = np.concatenate([X[np.isfinite(X[:, 2]), 2] for X in (seen.X_query, seen.X_match)])
    closest = NEAREST * float(np.median(near)) if len(near) else 1.0
    rays = [
        np.column_stack([(uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(uv))])
        for uv, camera in ((seen.uv_query, seen.query), (seen.uv_match, seen.match))
    ]
    # R ray + t / z lies on the match's ray; the cross product with that leaves a + b / z = 0.
    turned = rays[0] @ R.T
    a, b = np.cross(rays[1], turned), np.cross(rays[1], t[None])
    inverse = np.clip(-(a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-18), 0, 1 / closest)
    p = turned + t * inverse[:, None]
    ahead = p[:, 2] > 1e-6
    p[~ahead] = (0, 0, 1)
    error = np.linalg.norm(seen.match.project_ideal(p) - seen.uv_match, axis=1)
    return np.asarray(without & ahead & (error < limit_px)), without


def depth_sigma(T_match_query: Matrix, seen: Observations, inliers: Flags) -> float:
    """Return the standard deviation of inverse depth, measured between both sides, or 3 per cent where it cannot be."""
    measured = inliers & seen.measured
    X_match, X_query = seen.X_match[measured], seen.X_query[measured]
    both = np.isfinite(X_match).all(axis=1) & np.isfinite(X_query).all(axis=1)
    z = np.concatenate([X_match[:, 2][np.isfinite(X_match[:, 2])], X_query[:, 2][np.isfinite(X_query[:, 2])]])
    middle = 1.0 / float(np.median(z)) if len(z) else 1.0
    p = se3.transform(se3.inverse(T_match_query), X_match[both])[:, 2]
    ahead = p > 1e-9
    if ahead.sum() < DEPTH_PAIRS:
        return 0.03 * middle
    p, z_query, z_match = p[ahead], X_query[both][ahead, 2], X_match[both][ahead, 2]
    difference = (1 / p - 1 / z_query) / np.sqrt(1 + (z_match / p) ** 4)
    return max(1.4826 * float(np.median(np.abs(difference))), 1e-3 * middle)


def _inliers(T: Matrix, seen: Observations, sigma: float, config: VerificationConfig) -> Flags:
    """Return which matches (M,) appear where they should and, where both depths are known, at the right depth."""
    inliers: Flags = errors(T, seen) < config.reprojection_px
    p = se3.transform(se3.inverse(T), seen.X_match)[:, 2]
    s_query, s_match = seen.deviations(sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sqrt(s_query**2 + s_match**2 * (seen.X_match[:, 2] / p) ** 4)
        far = np.abs(1 / p - 1 / seen.X_query[:, 2]) > DEPTH_OUTLIER * np.maximum(spread, 0.02 / p)
    return np.asarray(inliers & ~far)


def _scaling(T: Matrix, seen: Observations, inliers: Flags) -> NDArray[np.float64]:
    """Return what makes radians and lengths comparable: (1, 1, 1, depth, depth, depth), depth that of the scene."""
    p = se3.transform(se3.inverse(T), seen.X_match[inliers])[:, 2]
    z = np.where(np.isfinite(p), p, seen.X_query[inliers, 2])
    depth = float(np.median(z))
    return np.array([1, 1, 1, depth, depth, depth])


def _well_conditioned(information: Matrix, scaling: NDArray[np.float64]) -> bool:
    scaled = information * np.outer(scaling, scaling)
    return bool(np.isfinite(scaled).all() and np.linalg.cond(scaled) < 1e9)
