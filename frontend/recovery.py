"""When flow fails: find the camera by descriptors against recent keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features, match_descriptors
from seamark.frontend.pose import Observations, PoseEstimate, estimate_pose
from seamark.frontend.types import Frame, Keyframe

MIN_INLIERS = 20  # descriptors of another view are weaker evidence than tracks
MIN_INLIER_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Recovered:
    """A pose found by descriptors, with the inliers' ``pixels`` (N, 2) as seen and ``landmarks`` (N, 3) in odom."""

    estimate: PoseEstimate
    pixels: NDArray[np.float32]
    landmarks: NDArray[np.float64]


def recover(frame: Frame, recent: Sequence[Keyframe], camera: Camera, config: FrontendConfig) -> Recovered | None:
    """Match a frame against keyframes in the order given; the first that explains it wins, None if none does."""
    if not recent:
        return None
    features = extract_features(frame.image, config.sift_features, config.sift_contrast)
    for keyframe in recent:
        matches = match_descriptors(features.descriptors, keyframe.features.descriptors)
        matches = matches[np.isfinite(keyframe.landmarks[matches[:, 1], 0])]
        if len(matches) < MIN_INLIERS or keyframe.T_odom_cam is None:
            continue
        seen = features.points[matches[:, 0]]
        landmarks = se3.transform(keyframe.T_odom_cam, keyframe.landmarks[matches[:, 1]])
        unknown = np.full(len(matches), np.nan)
        estimate = estimate_pose(
            Observations(landmarks, camera.undistort(seen), unknown, unknown),
            camera,
            threshold_px=config.pnp_threshold_px,
            iterations=4 * config.pnp_iterations,
            pixel_sigma=config.pixel_sigma,
            minimum=MIN_INLIERS,
        )
        if estimate is not None and estimate.inliers.mean() >= MIN_INLIER_SHARE:
            return Recovered(estimate, seen[estimate.inliers], landmarks[estimate.inliers])
    return None
