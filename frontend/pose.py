"""The camera's pose from landmarks: P3P-RANSAC, then robust Gauss-Newton on pixels and inverse depths."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera

HUBER = 1.345
CHI2_3DOF_99 = 11.34
ITERATIONS = 8
CONVERGED = 1e-7

# Shared errors of landmarks over one keyframe step: see motion_covariance.
ROTATION_FLOOR = 5e-4
ROTATION_PER_RADIAN = 0.005
ROTATION_PER_METRE = 0.001
TRANSLATION_FLOOR_M = 0.002
TRANSLATION_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Observations:
    """N landmarks seen by one camera.

    ``landmarks`` (N, 3) in the odometry frame, ``pixels`` (N, 2) ideal (undistorted), ``inverse_depth`` and
    ``inverse_sigma`` (N,) measured by the depth sensor in 1/m, NaN where it knew nothing.
    """

    landmarks: NDArray[np.float64]
    pixels: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    inverse_sigma: NDArray[np.float64]

    def __getitem__(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "Observations":
        """Select by mask or indices."""
        return Observations(
            self.landmarks[which], self.pixels[which], self.inverse_depth[which], self.inverse_sigma[which]
        )


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose with its evidence: ``inliers`` (N,) bool, median ``reprojection_px`` of them, ``covariance`` (6, 6)."""

    T_odom_cam: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    reprojection_px: float
    covariance: NDArray[np.float64]


def estimate_pose(
    observations: Observations,
    camera: Camera,
    *,
    threshold_px: float,
    iterations: int,
    pixel_sigma: float,
    minimum: int,
) -> PoseEstimate | None:
    """Estimate the pose without a guess; None when fewer than ``minimum`` landmarks agree.

    P3P after Ke and Roumeliotis (2017) within RANSAC, then :func:`refine_pose` twice, the second time on the inliers of
    the refined pose.
    """
    if len(observations.landmarks) < max(4, minimum):
        return None
    ok, rotation, translation, indices = cv2.solvePnPRansac(
        np.ascontiguousarray(observations.landmarks),
        np.ascontiguousarray(observations.pixels),
        camera.K,
        None,
        iterationsCount=iterations,
        reprojectionError=threshold_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or indices is None or len(indices) < minimum:
        return None
    T_cam_odom = se3.make(cv2.Rodrigues(rotation)[0], translation)
    T_odom_cam = se3.inverse(T_cam_odom)
    inliers = np.zeros(len(observations.landmarks), bool)
    inliers[indices.reshape(-1)] = True
    covariance = np.eye(6)
    for _ in range(2):
        try:
            T_odom_cam, covariance = refine_pose(T_odom_cam, observations[inliers], camera, pixel_sigma=pixel_sigma)
        except np.linalg.LinAlgError:  # landmarks on one line leave the rotation about it open
            return None
        errors, in_front = reprojection_errors(T_odom_cam, observations.landmarks, observations.pixels, camera)
        inliers = in_front & (errors < threshold_px)
        if inliers.sum() < minimum:
            return None
    return PoseEstimate(T_odom_cam, inliers, float(np.median(errors[inliers])), covariance)


def reprojection_errors(
    T_odom_cam: NDArray[np.float64], landmarks: NDArray[np.float64], pixels: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the distances (N,) in pixels between landmarks and where they are seen, and which are in front."""
    in_cam = se3.transform(se3.inverse(T_odom_cam), landmarks)
    in_front = in_cam[:, 2] > 1e-3
    safe = np.where(in_front[:, None], in_cam, [0, 0, 1])
    return np.linalg.norm(camera.project_ideal(safe) - pixels, axis=1), in_front


def residuals_and_jacobian(
    in_cam: NDArray[np.float64], observations: Observations, camera: Camera, pixel_sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return whitened residuals (N, 3) (u, v, inverse depth) and their derivative (N, 3, 3) by the point in the camera.

    Rows of an unknown inverse depth are zero.
    """
    x, y, z = in_cam.T
    inverse = 1 / z
    predicted = np.column_stack([camera.fx * x * inverse + camera.cx, camera.fy * y * inverse + camera.cy])
    residuals = np.zeros((len(z), 3))
    residuals[:, :2] = (predicted - observations.pixels) / pixel_sigma
    J = np.zeros((len(z), 3, 3))
    J[:, 0, 0] = camera.fx * inverse / pixel_sigma
    J[:, 0, 2] = -camera.fx * x * inverse**2 / pixel_sigma
    J[:, 1, 1] = camera.fy * inverse / pixel_sigma
    J[:, 1, 2] = -camera.fy * y * inverse**2 / pixel_sigma
    known = np.isfinite(observations.inverse_depth)
    sigma = observations.inverse_sigma[known]
    residuals[known, 2] = (inverse[known] - observations.inverse_depth[known]) / sigma
    J[known, 2, 2] = -(inverse[known] ** 2) / sigma
    return residuals, J


def pose_jacobian(in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivative (N, 3, 6) of points in the camera by a right perturbation of T_odom_cam, rotation first."""
    x, y, z = in_cam.T
    J = np.zeros((len(in_cam), 3, 6))
    J[:, 0, 1], J[:, 0, 2] = -z, y
    J[:, 1, 0], J[:, 1, 2] = z, -x
    J[:, 2, 0], J[:, 2, 1] = -y, x
    J[:, :, 3:] = -np.eye(3)
    return J


def retract(T: NDArray[np.float64], delta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply a small tangent step (6,), rotation first, on the right."""
    return T @ se3.make(se3.exp_rotation(delta[:3]), delta[3:])


def robust_weights(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Huber's weights (N, 3) of whitened residuals (N, 3): one for both pixel rows, one for the depth row."""
    pixel = np.linalg.norm(residuals[:, :2], axis=1)
    depth = np.abs(residuals[:, 2])
    w_pixel = np.minimum(1, HUBER / np.maximum(pixel, 1e-12))
    w_depth = np.minimum(1, HUBER / np.maximum(depth, 1e-12))
    return np.column_stack([w_pixel, w_pixel, w_depth])


def refine_pose(
    T_odom_cam: NDArray[np.float64], observations: Observations, camera: Camera, *, pixel_sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Minimise robust pixel and inverse-depth errors over the pose; return it with its covariance (6, 6).

    Raises numpy.linalg.LinAlgError when the landmarks do not determine the pose.
    """
    T = T_odom_cam
    H: NDArray[np.float64] = np.eye(6)
    for _ in range(ITERATIONS):
        in_cam = se3.transform(se3.inverse(T), observations.landmarks)
        in_cam[:, 2] = np.maximum(in_cam[:, 2], 1e-3)
        residuals, J_point = residuals_and_jacobian(in_cam, observations, camera, pixel_sigma)
        J = J_point @ pose_jacobian(in_cam)
        weights = robust_weights(residuals)
        Jw = (J * weights[:, :, None]).reshape(-1, 6)
        H = np.asarray(Jw.T @ J.reshape(-1, 6) + 1e-9 * np.eye(6), np.float64)
        delta = np.asarray(-np.linalg.solve(H, Jw.T @ residuals.reshape(-1)), np.float64)
        T = retract(T, delta)
        if float(delta @ delta) < CONVERGED**2:
            break
    spread = float(np.median(np.linalg.norm(residuals[:, :2], axis=1))) / 1.1774  # sigma of a Rayleigh median
    return se3.orthonormalise(T), np.asarray(np.linalg.inv(H) * max(1.0, spread) ** 2, np.float64)


def motion_covariance(
    T_odom_a: NDArray[np.float64], T_odom_b: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of the motion from a to b, of which ``covariance`` is the estimator's own at b.

    The estimator takes the landmarks for exact; what their shared errors add grows with the distance and the angle
    moved.
    """
    distance = float(np.linalg.norm(T_odom_b[:3, 3] - T_odom_a[:3, 3]))
    angle = float(se3.rotation_angle(T_odom_a[:3, :3].T @ T_odom_b[:3, :3]))
    sigma_rotation = ROTATION_FLOOR + ROTATION_PER_RADIAN * angle + ROTATION_PER_METRE * distance
    sigma_translation = TRANSLATION_FLOOR_M + TRANSLATION_SHARE * distance
    shared = np.diag([sigma_rotation**2] * 3 + [sigma_translation**2] * 3)
    return covariance + shared
