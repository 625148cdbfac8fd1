"""When flow fails: find the camera by descriptors against recent keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features, match_descriptors
from seamark.frontend.pose import PoseEstimate, Prediction, estimate_pose
from seamark.frontend.presumed import SPREAD, presume
from seamark.frontend.residuals import Observations
from seamark.frontend.types import Frame, Keyframe

MIN_INLIERS = 20  # descriptors of another view are weaker evidence than tracks
MIN_INLIER_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Recovered:
    """A pose found by descriptors, with the inliers' ``pixels`` (N, 2) as seen, ``landmarks`` (N, 3) in odom and their
    ``spread`` (N,).
    """

    estimate: PoseEstimate
    pixels: NDArray[np.float32]
    landmarks: NDArray[np.float64]
    spread: NDArray[np.float64]


def recover(
    frame: Frame, recent: Sequence[Keyframe], camera: Camera, config: FrontendConfig, prediction: Prediction
) -> Recovered | None:
    """Match a frame against keyframes in the order given; the first that explains it wins, None if none does."""
    if not recent:
        return None
    features = extract_features(frame.image, config.sift_features, config.sift_contrast, frame.mask, config.sift_pixels)
    for keyframe in recent:
        matches = match_descriptors(features.descriptors, keyframe.features.descriptors)
        landmarks, spread = _landmarks(keyframe, matches[:, 1], camera)
        placed = np.isfinite(spread)
        matches, landmarks, spread = matches[placed], landmarks[placed], spread[placed]
        if len(matches) < MIN_INLIERS or keyframe.T_odom_cam is None:
            continue
        seen = features.points[matches[:, 0]]
        unknown = np.full(len(matches), np.nan)
        landmarks, origin = se3.transform(keyframe.T_odom_cam, landmarks), keyframe.T_odom_cam[:3, 3]
        estimate = estimate_pose(
            Observations(landmarks, camera.undistort(seen), unknown, unknown, spread, origin),
            camera,
            threshold_px=config.pnp_threshold_px,
            iterations=6 * config.pnp_iterations,
            pixel_sigma=config.pixel_sigma,
            minimum=MIN_INLIERS,
            prediction=prediction,
        )
        if estimate is not None and estimate.inliers.mean() >= MIN_INLIER_SHARE:
            good = estimate.inliers
            return Recovered(estimate, seen[good], landmarks[good], spread[good])
    return None


def _landmarks(
    keyframe: Keyframe, chosen: NDArray[np.int64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the chosen key points in the keyframe's camera (N, 3) and their spreads (N,), NaN where unknown."""
    points, known = keyframe.features.points, np.isfinite(keyframe.landmarks[:, 0])
    landmarks = keyframe.landmarks[chosen].astype(np.float64)
    spread = np.where(known[chosen], 0.0, np.nan)
    missing = np.flatnonzero(~known[chosen])
    presumed = presume(points[chosen[missing]], points[known], keyframe.landmarks[known, 2])
    if presumed is not None:
        landmarks[missing] = camera.rays(points[chosen[missing]]) * presumed[:, None]
        spread[missing] = SPREAD
    return landmarks, spread
