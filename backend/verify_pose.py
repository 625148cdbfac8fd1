"""The pose between two cameras from the landmarks of one and the key points of the other."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Matrix = NDArray[np.float64]

REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A pose with its evidence.

    ``in_query_units`` tells whose landmarks were used: the query's (then the translation is in the query's units) or
    the match's. ``inliers`` (M,) bool over all matches, ``pairs`` how many of them had depth, ``points`` (I, 3) the
    inliers' landmarks in their own camera, ``residuals`` (I, 2) pixels, ``focal`` (2,) of the camera that sees them.
    """

    T_match_query: Matrix
    in_query_units: bool
    inliers: NDArray[np.bool_]
    pairs: int
    points: NDArray[np.float64]
    residuals: NDArray[np.float64]
    focal: NDArray[np.float64]


def usac_parameters(threshold_px: float, config: VerificationConfig, seed: int) -> cv2.UsacParams:
    """Return settings for MAGSAC++ (Barath et al. 2020) with a fixed random state."""
    parameters = cv2.UsacParams()
    parameters.threshold = threshold_px
    parameters.confidence = config.confidence
    parameters.maxIterations = config.iterations
    parameters.randomGeneratorState = seed & 0x7FFFFFFF
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.sampler = cv2.SAMPLING_UNIFORM
    return parameters


def estimate_pose(
    landmarks: NDArray[np.float64],
    pixels: NDArray[np.float64],
    camera: Camera,
    config: VerificationConfig,
    seed: int,
    in_query_units: bool,
) -> RelativePose | None:
    """Estimate the pose of ``camera``, which sees ideal ``pixels`` (M, 2), from ``landmarks`` (M, 3) of the other one.

    Sampling of three points, then Levenberg-Marquardt on the inliers, which are found anew in between. None where
    there are too few pairs or no pose explains them.
    """
    known = np.isfinite(landmarks).all(axis=1)
    if known.sum() < config.min_inliers:
        return None
    points, seen = np.ascontiguousarray(landmarks[known]), np.ascontiguousarray(pixels[known])
    parameters = usac_parameters(config.reprojection_px, config, seed)
    try:
        found, _, rotation, translation, _ = cv2.solvePnPRansac(points, seen, camera.K, None, params=parameters)
    except cv2.error:  # OpenCV 5.0 asserts when its last refinement degenerates
        return None
    if not found:
        return None
    T_camera_other = _from_vectors(rotation, translation)
    for _ in range(REFINEMENTS):
        inside = _residuals(T_camera_other, points, seen, camera)[1] < config.reprojection_px
        if inside.sum() < 6:
            return None
        rotation, translation = cv2.solvePnPRefineLM(
            points[inside], seen[inside], camera.K, None, rotation, translation
        )
        T_camera_other = _from_vectors(rotation, translation)
    residuals, errors = _residuals(T_camera_other, points, seen, camera)
    inside = errors < config.reprojection_px
    inliers = np.zeros(len(landmarks), bool)
    inliers[np.flatnonzero(known)[inside]] = True
    T_match_query = T_camera_other if in_query_units else se3.inverse(T_camera_other)
    focal = np.array([camera.fx, camera.fy])
    return RelativePose(
        T_match_query, in_query_units, inliers, int(known.sum()), points[inside], residuals[inside], focal
    )


def estimate_scale(
    pose: RelativePose, X_query: NDArray[np.float64], X_match: NDArray[np.float64], min_pairs: int
) -> tuple[float, float]:
    """Return match units per query unit and the standard deviation of its logarithm, from landmarks (M, 3) of both.

    The pose is right up to the unit of its translation, so each inlier with depth on both sides gives a ratio of
    depths; their median withstands wrong depths. (1, inf) where fewer than ``min_pairs`` inliers have both.
    """
    both = pose.inliers & np.isfinite(X_query).all(axis=1) & np.isfinite(X_match).all(axis=1)
    if pose.in_query_units:
        depth_query = se3.transform(pose.T_match_query, X_query[both])[:, 2]
        depth_match = X_match[both][:, 2]
    else:
        depth_query = X_query[both][:, 2]
        depth_match = se3.transform(se3.inverse(pose.T_match_query), X_match[both])[:, 2]
    positive = (depth_query > 0) & (depth_match > 0)
    if positive.sum() < min_pairs:
        return 1.0, float("inf")
    logarithms = np.log(depth_match[positive] / depth_query[positive])
    middle = float(np.median(logarithms))
    # 1.4826 x median deviation estimates a normal's sigma, 1.2533 / sqrt(n) is what a median makes of it.
    spread = 1.4826 * float(np.median(np.abs(logarithms - middle)))
    sigma = 1.2533 * spread / np.sqrt(len(logarithms))
    return float(np.exp(middle)), max(float(sigma), 5e-3)


def pose_covariance(pose: RelativePose, config: VerificationConfig) -> Matrix | None:
    """Return the (6, 6) covariance in the query's tangent space, or None where the geometry is degenerate.

    Inverse of the Gauss-Newton matrix of the reprojection errors, inflated because landmarks are taken as exact, and
    with a floor. Lengths are in the units of the pose's translation.
    """
    R = pose.T_match_query[:3, :3]
    hats = np.zeros((len(pose.points), 3, 3))
    if pose.in_query_units:
        # p = T_match_query exp(xi) X: dp = R (omega x X + v).
        p = se3.transform(pose.T_match_query, pose.points)
        _fill_hat(hats, pose.points)
        motion = np.concatenate([-R @ hats, np.broadcast_to(R, hats.shape)], axis=2)
    else:
        # p = exp(-xi) T_query_match X: dp = -(omega x p + v).
        p = se3.transform(se3.inverse(pose.T_match_query), pose.points)
        _fill_hat(hats, p)
        motion = np.concatenate([hats, np.broadcast_to(-np.eye(3), hats.shape)], axis=2)
    projection = np.zeros((len(p), 2, 3))
    projection[:, 0, 0], projection[:, 1, 1] = (pose.focal / p[:, 2:]).T
    projection[:, :, 2] = -pose.focal * p[:, :2] / p[:, 2:] ** 2
    J = (projection @ motion).reshape(-1, 6)
    variance = max(config.noise_px**2, float((pose.residuals**2).sum() / max(2 * len(p) - 6, 1)))
    depth = float(np.median(p[:, 2]))
    scaling = np.array([1, 1, 1, depth, depth, depth])  # makes radians and lengths comparable for the condition
    information = (J * scaling).T @ (J * scaling)
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e9:
        return None
    covariance = scaling[:, None] * np.linalg.inv(information) * scaling * variance * config.covariance_inflation
    floors = np.repeat([np.deg2rad(config.rotation_floor_deg), config.translation_floor_fraction * depth], 3)
    return np.asarray(0.5 * (covariance + covariance.T) + np.diag(floors**2))


def _residuals(
    T_camera_other: Matrix, points: NDArray[np.float64], seen: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return reprojection errors (M, 2) and their lengths (M,) in pixels; infinite behind the camera."""
    p = se3.transform(T_camera_other, points)
    ahead = p[:, 2] > 1e-9
    p[~ahead] = (0, 0, 1)
    residuals = camera.project_ideal(p) - seen
    return residuals, np.where(ahead, np.linalg.norm(residuals, axis=1), np.inf)


def _from_vectors(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Matrix:
    return se3.make(cv2.Rodrigues(rotation.reshape(3, 1))[0], translation)


def _fill_hat(out: Matrix, v: NDArray[np.float64]) -> None:
    """Write the skew-symmetric matrices of v (N, 3) to ``out`` (N, 3, 3)."""
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
