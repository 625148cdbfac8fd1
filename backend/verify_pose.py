"""Hypotheses of the pose between two cameras, from the landmarks of one and the key points of the other."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose from the landmarks of one side.

    ``in_query_units`` tells whose landmarks were used: the query's (then the translation is in the query's units) or
    the match's. ``inliers`` (M,) bool over all matches, ``pairs`` how many of them had depth.
    """

    T_match_query: Matrix
    in_query_units: bool
    inliers: NDArray[np.bool_]
    pairs: int


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
) -> Hypothesis | None:
    """Estimate the pose of ``camera``, which sees ideal ``pixels`` (M, 2), from ``landmarks`` (M, 3) of the other one.

    Sampling of three points; None where there are too few pairs or no pose explains them.
    """
    known = np.flatnonzero(np.isfinite(landmarks).all(axis=1))
    if len(known) < config.min_inliers:
        return None
    points, seen = np.ascontiguousarray(landmarks[known]), np.ascontiguousarray(pixels[known])
    parameters = usac_parameters(config.reprojection_px, config, seed)
    try:
        found, _, rotation, translation, _ = cv2.solvePnPRansac(points, seen, camera.K, None, params=parameters)
    except cv2.error:  # OpenCV 5.0 asserts when its last refinement degenerates
        return None
    if not found or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    T_camera_other = se3.make(cv2.Rodrigues(rotation.reshape(3, 1))[0], translation)
    p = se3.transform(T_camera_other, points)
    ahead = p[:, 2] > 1e-9
    p[~ahead] = (0, 0, 1)
    near = ahead & (np.linalg.norm(camera.project_ideal(p) - seen, axis=1) < config.reprojection_px)
    inliers = np.zeros(len(landmarks), bool)
    inliers[known[near]] = True
    T_match_query = T_camera_other if in_query_units else se3.inverse(T_camera_other)
    return Hypothesis(T_match_query, in_query_units, inliers, len(known))


def estimate_scale(
    T_match_query: Matrix,
    in_query_units: bool,
    inliers: NDArray[np.bool_],
    X_query: NDArray[np.float64],
    X_match: NDArray[np.float64],
    min_pairs: int,
) -> tuple[float, float]:
    """Return match units per query unit and the standard deviation of its logarithm, from landmarks (M, 3) of both.

    The pose is right up to the unit of its translation, so each inlier with depth on both sides gives a ratio of
    depths; their median withstands wrong depths. (1, inf) where fewer than ``min_pairs`` inliers have both.
    """
    both = inliers & np.isfinite(X_query).all(axis=1) & np.isfinite(X_match).all(axis=1)
    if in_query_units:
        depth_query = se3.transform(T_match_query, X_query[both])[:, 2]
        depth_match = X_match[both][:, 2]
    else:
        depth_query = X_query[both][:, 2]
        depth_match = se3.transform(se3.inverse(T_match_query), X_match[both])[:, 2]
    positive = (depth_query > 0) & (depth_match > 0)
    if positive.sum() < min_pairs:
        return 1.0, float("inf")
    logarithms = np.log(depth_match[positive] / depth_query[positive])
    middle = float(np.median(logarithms))
    # 1.4826 x median deviation estimates a normal's sigma, 1.2533 / sqrt(n) is what a median makes of it.
    spread = 1.4826 * float(np.median(np.abs(logarithms - middle)))
    sigma = 1.2533 * spread / np.sqrt(len(logarithms))
    return float(np.exp(middle)), max(float(sigma), 5e-3)
