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
from seamark.frontend.types import Features, Frame, Keyframe

MIN_INLIERS = 20  # descriptors of another view are weaker evidence than tracks
MIN_INLIER_SHARE = 0.25
IMPRECISION = 2.0  # times the error of a track
PRECISE_SHARE = 0.6


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
        if keyframe.T_odom_cam is None:
            continue
        pixels, observations = _matched(features, keyframe, camera)
        estimate = _estimate(observations, camera, config, prediction)
        if estimate is not None:
            good = observations[estimate.inliers]
            assert good.spread is not None
            return Recovered(estimate, pixels[estimate.inliers], good.landmarks, good.spread)
    return None


def _estimate(
    observations: Observations, camera: Camera, config: FrontendConfig, prediction: Prediction
) -> PoseEstimate | None:
    """Estimate the pose from key points of another view, which blur and fewer pixels make less precise than tracks.

    They are taken as such first: among imprecise ones a few agree by chance on a pose that is wrong. The error of a
    track is asked for where most of them keep it.
    """

    def within(threshold_px: float, start: PoseEstimate | None) -> PoseEstimate | None:
        return estimate_pose(
            observations,
            camera,
            threshold_px=threshold_px,
            iterations=6 * config.pnp_iterations,
            pixel_sigma=config.pixel_sigma,
            minimum=MIN_INLIERS,
            prediction=prediction,
            start=start,
        )

    rough = within(IMPRECISION * config.pnp_threshold_px, None)
    if rough is None or rough.inliers.mean() < MIN_INLIER_SHARE:
        return None
    precise = within(config.pnp_threshold_px, rough)
    kept = 0 if precise is None else precise.inliers.sum()
    return precise if kept >= PRECISE_SHARE * rough.inliers.sum() else rough


def _matched(features: Features, keyframe: Keyframe, camera: Camera) -> tuple[NDArray[np.float32], Observations]:
    """Return where landmarks of a posed keyframe are seen, (N, 2) pixels, and the same as observations of them."""
    assert keyframe.T_odom_cam is not None
    matches = match_descriptors(features.descriptors, keyframe.features.descriptors)
    landmarks, spread = _landmarks(keyframe, matches[:, 1], camera)
    placed = np.isfinite(spread)
    pixels = features.points[matches[placed, 0]]
    landmarks, origin = se3.transform(keyframe.T_odom_cam, landmarks[placed]), keyframe.T_odom_cam[:3, 3]
    unknown = np.full(len(pixels), np.nan)
    return pixels, Observations(landmarks, camera.undistort(pixels), unknown, unknown, spread[placed], origin)


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
