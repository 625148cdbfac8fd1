"""Landmarks beyond the reach of the depth sensor, from the odometry between neighbouring keyframes.

What one keyframe sees without depth, the one before or after it often sees too. Odometry says how they lie to each
other, so the feature's inverse depth follows, and from the noise of key points and odometry how sure it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.features import match_descriptors
from seamark.frontend.types import Keyframe

Array = NDArray[np.float64]

STEPS = 3
MOST_DEVIATION = 0.2  # of the inverse depth: what is less sure bends the errors of a pose
AGREEMENT = 3.0  # standard deviations that two neighbours may differ by
BEHIND_PX = 1e6


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The landmarks of a keyframe's N features.

    ``points`` (N, 3) in its camera, NaN where unknown; ``sigma`` (N,) the standard deviation of inverse depth of those
    that were triangulated, NaN for the others.
    """

    points: Array
    sigma: Array

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return which features (N,) have a landmark."""
        return np.asarray(np.isfinite(self.points).all(axis=1))


def measured_landmarks(keyframe: Keyframe) -> Landmarks:
    """Return what the keyframe came with; nothing is known of one whose landmarks do not fit its features."""
    count = len(keyframe.features)
    points = np.full((count, 3), np.nan)
    if len(keyframe.landmarks) == count:
        points = keyframe.landmarks.astype(np.float64)
    return Landmarks(points, np.full(count, np.nan))


def with_far_landmarks(keyframe: Keyframe, neighbours: Sequence[Keyframe], config: VerificationConfig) -> Landmarks:
    """Return the keyframe's landmarks and those that it and its ``neighbours`` of the same session triangulate.

    Neighbours that disagree of a feature leave it without. Nothing is added without calibration or odometry.
    """
    found = measured_landmarks(keyframe)
    without = np.flatnonzero(~found.known)
    if keyframe.camera is None or keyframe.T_odom_cam is None or len(without) < config.min_inliers:
        return found
    inverse, weight = np.zeros(len(without)), np.zeros(len(without))
    torn = np.zeros(len(without), bool)
    for neighbour in neighbours:
        pairs = match_descriptors(
            keyframe.features.descriptors[without], neighbour.features.descriptors, ratio=config.match_ratio
        )
        rows, value, sigma = _inverse_depths(keyframe, neighbour, without, pairs, config)
        before = weight[rows] > 0
        mean = inverse[rows] / np.where(before, weight[rows], 1.0)
        spread = np.sqrt(sigma**2 + 1 / np.where(before, weight[rows], 1.0))
        torn[rows] |= before & (np.abs(value - mean) > AGREEMENT * spread)
        inverse[rows] += value / sigma**2
        weight[rows] += 1 / sigma**2
    known = (weight > 0) & ~torn
    known[known] = inverse[known] * MOST_DEVIATION > np.sqrt(weight[known])
    rows, value = without[known], inverse[known] / weight[known]
    found.points[rows] = keyframe.camera.rays(keyframe.features.points[rows]) / value[:, None]
    found.sigma[rows] = 1 / np.sqrt(weight[known])
    return found


def _inverse_depths(
    keyframe: Keyframe,
    neighbour: Keyframe,
    without: NDArray[np.int64],
    pairs: NDArray[np.int64],
    config: VerificationConfig,
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the rows (K,) of ``without`` that a neighbour sees too, their inverse depths and standard deviations."""
    nothing = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    if neighbour.camera is None or neighbour.T_odom_cam is None or not len(pairs):
        return nothing
    assert keyframe.camera is not None and keyframe.T_odom_cam is not None
    T = se3.inverse(neighbour.T_odom_cam) @ keyframe.T_odom_cam
    rays = keyframe.camera.rays(keyframe.features.points[without[pairs[:, 0]]])
    uv = neighbour.camera.undistort(neighbour.features.points[pairs[:, 1]])
    turned = rays @ T[:3, :3].T
    value = _on_epipolar_line(turned, T[:3, 3], uv, neighbour.camera)
    for _ in range(STEPS):
        error, slope = _error_along(turned, T[:3, 3], value, uv, neighbour.camera)
        value = value - (error * slope).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-12)
    error, slope = _error_along(turned, T[:3, 3], value, uv, neighbour.camera)
    turning, moving = _motion_deviations(keyframe, neighbour)
    focal = neighbour.camera.fx
    pixels = np.sqrt(2 * config.noise_px**2 + (focal * turning) ** 2 + (focal * moving * value) ** 2)
    sigma = pixels / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    good = (np.linalg.norm(error, axis=1) < config.epipolar_px) & (value > sigma) & np.isfinite(sigma)
    return pairs[good, 0], value[good], sigma[good]


def _on_epipolar_line(turned: Array, t: Array, uv: Array, camera: Camera) -> Array:
    """Return the inverse depths (K,) at which rays ``turned`` (K, 3) into a view, moved by ``t``, pass its pixels."""
    seen = np.column_stack([(uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(uv))])
    a, b = np.cross(seen, turned), np.cross(seen, t[None])
    return np.asarray(-(a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-18))


def _error_along(turned: Array, t: Array, inverse: Array, uv: Array, camera: Camera) -> tuple[Array, Array]:
    """Return the reprojection errors (K, 2), huge behind the camera, and how they change with inverse depth (K, 2)."""
    p = turned + t * inverse[:, None]
    ahead = p[:, 2] > 1e-6
    p[~ahead] = (0, 0, 1)
    focal = np.array([camera.fx, camera.fy])
    slope = focal * (t[:2] * p[:, 2:] - p[:, :2] * t[2]) / p[:, 2:] ** 2
    error = camera.project_ideal(p) - uv
    error[~ahead] = BEHIND_PX
    slope[~ahead] = 0
    return error, slope


def _motion_deviations(keyframe: Keyframe, neighbour: Keyframe) -> tuple[float, float]:
    """Return the standard deviations of turn (rad) and way between two neighbours, each in its worst direction."""
    later = keyframe if keyframe.previous_id == neighbour.id else neighbour
    if later.covariance is None:
        return 0.0, 0.0
    turning, moving = (
        float(np.sqrt(max(np.linalg.eigvalsh(later.covariance[part, part])[-1], 0.0)))
        for part in (slice(3), slice(3, 6))
    )
    return turning, moving
