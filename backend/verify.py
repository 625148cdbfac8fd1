"""Geometric verification: do two keyframes show the same place, and how do their cameras lie to each other?"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.matching import Matches, match_features
from seamark.backend.types import Reason
from seamark.backend.verify_pose import RelativePose, estimate_pose, estimate_scale, pose_covariance, usac_parameters
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]

SPREAD_CELLS = (8, 6)


@dataclass(frozen=True, eq=False)
class Verification:
    """Two keyframes show the same place.

    ``T_match_query`` (4, 4) with translation in the match's units and ``covariance`` (6, 6) in the query's frame and
    units, rotation first; both None where the geometry tells the place only (no depth, or no calibration). ``scale``
    is match units per query unit with ``scale_sigma`` of its logarithm, infinite where it could not be measured.
    """

    inliers: int
    matches: int
    T_match_query: Matrix | None = None
    covariance: Matrix | None = None
    scale: float = 1.0
    scale_sigma: float = 1e-3


@dataclass(frozen=True)
class Rejected:
    """Geometry does not support that two keyframes show the same place, and why."""

    reason: Reason
    inliers: int
    matches: int


def verify(query: Keyframe, match: Keyframe, config: VerificationConfig, seed: int) -> Verification | Rejected:
    """Compare two keyframes by descriptors, then by the geometry that is known of them.

    With calibration and depth on either side: pose from 3D-2D pairs. With calibration only: essential matrix, else
    fundamental matrix; these tell the place and no metric pose. The same input and ``seed`` give the same result.
    """
    matches = match_features(query.features, match.features, config.match_ratio)
    if len(matches) < config.min_matches:
        return Rejected(Reason.FEW_MATCHES, 0, len(matches))
    if query.camera is None or match.camera is None:
        return _verify_epipolar(query, match, matches, config, seed)
    depth_pairs = max(
        np.isfinite(_landmarks(match)[matches.match]).all(1).sum(),
        np.isfinite(_landmarks(query)[matches.query]).all(1).sum(),
    )
    if depth_pairs < config.min_inliers:
        return _verify_epipolar(query, match, matches, config, seed)
    return _verify_pose(query, match, matches, config, seed)


def _verify_pose(
    query: Keyframe, match: Keyframe, matches: Matches, config: VerificationConfig, seed: int
) -> Verification | Rejected:
    """Estimate the pose from either side's landmarks and keep the better one."""
    best = _best_pose(query, match, matches, config, seed)
    if best is None:
        return Rejected(Reason.FEW_INLIERS, 0, len(matches))
    count = int(best.inliers.sum())
    if count < config.min_inliers or count < config.min_inlier_ratio * best.pairs:
        return Rejected(Reason.FEW_INLIERS, count, len(matches))
    if not _well_spread(query, match, matches, best.inliers, config):
        return Rejected(Reason.BAD_GEOMETRY, count, len(matches))
    T_match_query, scale, scale_sigma = best.T_match_query, 1.0, 1e-3
    if not (query.metric and match.metric):
        scale, scale_sigma = estimate_scale(
            best, _landmarks(query)[matches.query], _landmarks(match)[matches.match], config.min_scale_pairs
        )
        if best.in_query_units and np.isfinite(scale_sigma):
            T_match_query = T_match_query.copy()
            T_match_query[:3, 3] *= scale
        elif best.in_query_units:
            return Rejected(Reason.BAD_GEOMETRY, count, len(matches))
    covariance = pose_covariance(best, config)
    if covariance is None:
        return Rejected(Reason.BAD_GEOMETRY, count, len(matches))
    if not best.in_query_units:
        # A tangent vector of the query's frame is in the query's units.
        covariance[3:, :] /= scale
        covariance[:, 3:] /= scale
    return Verification(count, len(matches), T_match_query, covariance, scale, scale_sigma)


def _best_pose(
    query: Keyframe, match: Keyframe, matches: Matches, config: VerificationConfig, seed: int
) -> RelativePose | None:
    """Estimate the pose with the match's and with the query's landmarks; more inliers win, the match's on a tie."""
    assert query.camera is not None and match.camera is not None
    poses = []
    X_match = _landmarks(match)[matches.match]
    uv_query = query.camera.undistort(query.features.points[matches.query])
    poses.append(estimate_pose(X_match, uv_query, query.camera, config, seed, in_query_units=False))
    X_query = _landmarks(query)[matches.query]
    uv_match = match.camera.undistort(match.features.points[matches.match])
    poses.append(estimate_pose(X_query, uv_match, match.camera, config, seed, in_query_units=True))
    found = [pose for pose in poses if pose is not None]
    return max(found, key=lambda pose: int(pose.inliers.sum()), default=None)


def _verify_epipolar(
    query: Keyframe, match: Keyframe, matches: Matches, config: VerificationConfig, seed: int
) -> Verification | Rejected:
    """Fit the essential (calibrated) or fundamental matrix and count what it explains; there is no metric pose."""
    points_query = query.features.points[matches.query].astype(np.float64)
    points_match = match.features.points[matches.match].astype(np.float64)
    parameters = usac_parameters(config.epipolar_px, config, seed)
    if query.camera is not None and match.camera is not None:
        points_query, points_match = query.camera.undistort(points_query), match.camera.undistort(points_match)
        K = (query.camera.K, match.camera.K)
        fit = partial(cv2.findEssentialMat, points_query, points_match, *K, None, None, parameters)
    else:
        fit = partial(cv2.findFundamentalMat, points_query, points_match, parameters)
    try:
        model, mask = fit()
    except cv2.error:
        # OpenCV 5.0 asserts when its last refinement degenerates, as it does for two almost equal images.
        limits = (config.epipolar_px, config.confidence, config.iterations)
        model, mask = cv2.findFundamentalMat(points_query, points_match, cv2.FM_RANSAC, *limits)
    if model is None or mask is None or model.shape != (3, 3) or not np.isfinite(model).all():
        return Rejected(Reason.FEW_INLIERS, 0, len(matches))
    inliers = mask.reshape(-1).astype(bool)
    count = int(inliers.sum())
    if count < config.min_epipolar_inliers or count < config.min_epipolar_ratio * len(matches):
        return Rejected(Reason.FEW_INLIERS, count, len(matches))
    if not _well_spread(query, match, matches, inliers, config):
        return Rejected(Reason.BAD_GEOMETRY, count, len(matches))
    return Verification(count, len(matches), scale_sigma=float("inf"))


def _well_spread(
    query: Keyframe, match: Keyframe, matches: Matches, inliers: NDArray[np.bool_], config: VerificationConfig
) -> bool:
    """Return whether the inliers neither crowd in one spot nor lie on a line, in both images."""
    for keyframe, indices in ((query, matches.query[inliers]), (match, matches.match[inliers])):
        points = keyframe.features.points
        size = np.ptp(points, axis=0).astype(np.float64) + 1.0
        origin = points.min(axis=0).astype(np.float64)
        if keyframe.camera is not None:
            size, origin = np.array([keyframe.camera.width, keyframe.camera.height], np.float64), np.zeros(2)
        seen = points[indices]
        cells = np.clip((seen - origin) / size * SPREAD_CELLS, 0, np.array(SPREAD_CELLS) - 1).astype(np.int64)
        if len(np.unique(cells, axis=0)) < config.min_cells:
            return False
        hull = cv2.convexHull(np.ascontiguousarray(seen, np.float32))
        if cv2.contourArea(hull) < config.min_hull_fraction * size[0] * size[1]:
            return False
    return True


def _landmarks(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return the landmarks (N, 3) float64, NaN where unknown; all NaN for a keyframe that has none."""
    count = len(keyframe.features)
    if len(keyframe.landmarks) != count:
        return np.full((count, 3), np.nan)
    return keyframe.landmarks.astype(np.float64)
