"""The camera's pose from landmarks: P3P-RANSAC, then robust Gauss-Newton on pixels and inverse depths."""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.kernels import native
from seamark.frontend.residuals import Observations, residuals_and_jacobian, shift_of_distance

ITERATIONS = 8
CONVERGED = 1e-7
RAYLEIGH_MEDIAN = 1.1774  # per sigma of either coordinate
NEAREST_M = 1e-3
CONTESTED_SHARE = 0.8  # of all votes: where fewer agree with a pose, others are asked for

Array: TypeAlias = NDArray[np.float64]

# Errors that the landmarks share over one keyframe step: see motion_covariance.
TRACKING_PX = 0.22  # median error of landmarks that nothing but the noise of tracking moves
SYSTEMATIC_SHARE = 2.0  # of what residuals exceed that by
ROTATION_FLOOR = 2e-4
ROTATION_PER_RADIAN = 0.002
TRANSLATION_SHARE = 0.004
MONO_TRANSLATION_SHARE = 0.03  # the scale drifts


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose with its evidence: ``inliers`` (N,) bool, median ``reprojection_px`` of them, ``covariance`` (6, 6)."""

    T_odom_cam: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    reprojection_px: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where the camera is expected, ``T_odom_cam``, with the standard deviation of its position in metres."""

    T_odom_cam: NDArray[np.float64]
    sigma_m: float


def estimate_pose(
    observations: Observations,
    camera: Camera,
    *,
    threshold_px: float,
    iterations: int,
    pixel_sigma: float,
    minimum: int,
    prediction: Prediction | None = None,
    votes: NDArray[np.float64] | None = None,
    start: PoseEstimate | None = None,
) -> PoseEstimate | None:
    """Estimate the pose; None when fewer than ``minimum`` landmarks agree.

    The prediction is refined first; where nearly all landmarks agree with what it leads to, that is the pose. Elsewhere
    P3P after Ke and Roumeliotis (2017) within RANSAC, then :func:`converge`. With a prediction, landmarks of uncertain
    distance take part: they hold the rotation, and the translation across their line of sight. ``votes`` (N,) weigh the
    landmarks where they disagree: then what the others agree on, and what is predicted, stand for election beside the
    largest consensus. A ``start``, the pose of the same landmarks when their pixels were hardly different, is refined
    without sampling.
    """
    if len(observations.landmarks) < max(4, minimum):
        return None
    votes = np.ones(len(observations.landmarks)) if votes is None else votes

    def converged(T_odom_cam: Array, inliers: NDArray[np.bool_]) -> tuple[PoseEstimate, float] | None:
        return converge(
            T_odom_cam,
            inliers,
            observations,
            camera,
            threshold_px=threshold_px,
            pixel_sigma=pixel_sigma,
            minimum=minimum,
            prediction=prediction,
            votes=votes,
        )

    if start is not None:
        found = converged(start.T_odom_cam, start.inliers)
        return None if found is None else found[0]
    expected = None
    if prediction is not None:
        expected = converged(prediction.T_odom_cam, np.ones(len(observations.landmarks), bool))
        if expected is not None and votes[expected[0].inliers].sum() >= CONTESTED_SHARE * votes.sum():
            return expected[0]
    sample = _as_good_as_exact(observations, camera, threshold_px, pixel_sigma, prediction)
    starts = _starts(observations, sample, camera, threshold_px, iterations, minimum, votes)
    candidates = [expected, *(converged(*one) for one in starts)]
    return min((c for c in candidates if c is not None), key=lambda found: found[1], default=(None, 0.0))[0]


def _starts(
    observations: Observations,
    sample: NDArray[np.int64],
    camera: Camera,
    threshold_px: float,
    iterations: int,
    minimum: int,
    votes: NDArray[np.float64],
) -> list[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Return the poses that samples lead to, with the landmarks (N,) that speak for each."""
    if len(sample) < 2 * minimum:  # too few to sample from
        sample = np.arange(len(observations.landmarks))
    starts = _sample_consensus(observations, sample, camera, threshold_px, iterations, minimum)
    if starts and votes[starts[0][1]].sum() < CONTESTED_SHARE * votes.sum():
        others = sample[~starts[0][1][sample]]
        starts += _sample_consensus(observations, others, camera, threshold_px, iterations, minimum)
    return starts


def _sample_consensus(
    observations: Observations,
    sample: NDArray[np.int64],
    camera: Camera,
    threshold_px: float,
    iterations: int,
    minimum: int,
) -> list[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Return the pose that most of the sample agree on, with those (N,), or nothing when fewer than the minimum do."""
    if len(sample) < max(4, minimum):
        return []
    ok, rotation, translation, indices = cv2.solvePnPRansac(
        np.ascontiguousarray(observations.landmarks[sample]),
        np.ascontiguousarray(observations.pixels[sample]),
        camera.K,
        None,
        iterationsCount=iterations,
        reprojectionError=threshold_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or indices is None or len(indices) < minimum:
        return []
    inliers = np.zeros(len(observations.landmarks), bool)
    inliers[sample[indices.reshape(-1)]] = True
    return [(se3.inverse(se3.make(cv2.Rodrigues(rotation)[0], translation)), inliers)]


def converge(
    T_odom_cam: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    observations: Observations,
    camera: Camera,
    *,
    threshold_px: float,
    pixel_sigma: float,
    minimum: int,
    votes: NDArray[np.float64],
    prediction: Prediction | None = None,
) -> tuple[PoseEstimate, float] | None:
    """Refine a pose on its inliers (N,), and again on those it leads to where they are others.

    Minimises robust pixel and inverse-depth errors by Gauss-Newton. What the uncertain distance of a landmark explains
    of an error is taken off. Returns the estimate with its error, truncated and weighted by ``votes`` (N,), or None
    where the landmarks do not determine the pose or fewer than ``minimum`` agree with it.
    """
    o = observations
    found = native.converge(
        np.ascontiguousarray(T_odom_cam),
        inliers,
        np.ascontiguousarray(o.landmarks),
        np.ascontiguousarray(o.pixels),
        np.ascontiguousarray(o.inverse_depth),
        np.ascontiguousarray(o.inverse_sigma),
        None if o.spread is None else np.ascontiguousarray(o.spread),
        None if o.origin is None else np.ascontiguousarray(o.origin),
        votes,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        pixel_sigma,
        None if prediction is None else np.ascontiguousarray(prediction.T_odom_cam[:3, 3]),
        1.0 if prediction is None else prediction.sigma_m,
        threshold_px,
        NEAREST_M,
        minimum,
        ITERATIONS,
        CONVERGED,
    )
    if found is None:
        return None
    T, H, inliers, noise, reprojection_px, score = found
    try:
        covariance = np.asarray(np.linalg.inv(H) * max(1.0, noise / RAYLEIGH_MEDIAN) ** 2, np.float64)
    except np.linalg.LinAlgError:  # landmarks on one line leave the rotation about it open
        return None
    return PoseEstimate(T, inliers, reprojection_px, covariance), score


def _as_good_as_exact(
    observations: Observations,
    camera: Camera,
    threshold_px: float,
    pixel_sigma: float,
    prediction: Prediction | None,
) -> NDArray[np.int64]:
    """Return the landmarks whose uncertain distance hardly shows in the image, as indices."""
    if observations.spread is None or prediction is None:
        return np.arange(len(observations.landmarks))
    in_cam = se3.transform(se3.inverse(prediction.T_odom_cam), observations.landmarks)
    in_cam[:, 2] = np.maximum(in_cam[:, 2], 1e-3)
    _, J_point = residuals_and_jacobian(in_cam, observations, camera, pixel_sigma)
    shift = shift_of_distance(prediction.T_odom_cam, in_cam, observations, J_point)
    return np.flatnonzero(np.linalg.norm(shift, axis=1) * pixel_sigma < 0.5 * threshold_px)


def motion_covariance(
    T_odom_a: NDArray[np.float64],
    T_odom_b: NDArray[np.float64],
    estimate: PoseEstimate | None,
    *,
    focal_px: float,
    depth: float,
    metric: bool,
) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of the motion from a to b, rotation first, of which ``estimate`` gave the pose b.

    The estimator takes landmarks for exact and errors of pixels for independent. Shutters that roll, depth that comes
    late and calibrations that err move many pixels together: what the residuals exceed the noise of tracking by is
    taken for such an angle, which ``depth``, the distance of the scene, turns into a translation. Errors of landmarks
    add shares of the angle and the distance moved.
    """
    distance = float(np.linalg.norm(T_odom_b[:3, 3] - T_odom_a[:3, 3]))
    angle = float(se3.rotation_angle(T_odom_a[:3, :3].T @ T_odom_b[:3, :3]))
    excess_px = 0.0 if estimate is None else np.sqrt(max(0.0, estimate.reprojection_px**2 - TRACKING_PX**2))
    systematic = SYSTEMATIC_SHARE * excess_px / focal_px
    share = TRANSLATION_SHARE if metric else MONO_TRANSLATION_SHARE
    sigma_rotation = np.hypot(systematic, ROTATION_FLOOR + ROTATION_PER_RADIAN * angle)
    sigma_translation = np.hypot(depth * systematic, depth * ROTATION_FLOOR + share * distance)
    own = np.zeros((6, 6)) if estimate is None else estimate.covariance
    return own + np.diag([sigma_rotation**2] * 3 + [sigma_translation**2] * 3)
