"""Where depth comes from: the one difference between mono, stereo and RGB-D.

Every sensor answers with the inverse depth (1/m) of points and its standard deviation, NaN where it knows nothing:
inverse depth is what both a disparity and a triangulation measure, and its noise stays Gaussian at long range.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import flow, se3
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import grey_of
from seamark.frontend.types import Frame, Mode, Rig

EPIPOLAR_PX = 1.5
EDGE_SPREAD = 0.05  # relative depth range in a 3x3 neighbourhood that marks a depth edge


class DepthSensor(Protocol):
    """Gives inverse depths of pixels of ``Frame.image``."""

    def inverse_depth(self, frame: Frame, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and its sigma, each (N,) in 1/m, NaN where unknown, for pixels (N, 2) as seen."""
        ...


class NoDepth:
    """Mono: depth comes from motion only."""

    def inverse_depth(self, frame: Frame, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all unknown."""
        return np.full(len(points), np.nan), np.full(len(points), np.nan)


class DepthImage:
    """RGB-D: the registered depth image, read at the nearest pixel, without points on depth edges."""

    def __init__(self, rig: Rig, config: FrontendConfig) -> None:
        self._depth_factor = rig.depth_factor
        self._config = config

    def inverse_depth(self, frame: Frame, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and sigma after the sensor's noise model (sigma_z = floor + c z^2, Khoshelham 2012)."""
        unknown = np.full(len(points), np.nan)
        if frame.depth is None or len(points) == 0:
            return unknown, unknown.copy()
        depth = frame.depth
        height, width = depth.shape
        x = np.clip(np.rint(points[:, 0]).astype(int), 1, width - 2)
        y = np.clip(np.rint(points[:, 1]).astype(int), 1, height - 2)
        around = np.stack([depth[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).astype(np.float64)
        if depth.dtype == np.uint16:
            around /= self._depth_factor
        around[~np.isfinite(around) | (around <= 0)] = np.nan
        z = around[4]
        c = self._config
        with np.errstate(invalid="ignore"):
            valid = (z > c.depth_min_m) & (z < c.depth_max_m)
            known = np.where(np.isnan(around), z, around)
            spread = known.max(axis=0) - known.min(axis=0)
            valid &= spread < np.maximum(EDGE_SPREAD * z, 4 * (c.depth_sigma_floor_m + c.depth_sigma_per_m2 * z**2))
        z = np.where(valid, z, np.nan)
        sigma_z = c.depth_sigma_floor_m + c.depth_sigma_per_m2 * z**2
        return 1 / z, sigma_z / z**2


class StereoPair:
    """Stereo: Lucas-Kanade from the left to the right image with a left-right check and the epipolar constraint."""

    def __init__(self, rig: Rig, config: FrontendConfig) -> None:
        assert rig.cam1 is not None and rig.T_cam0_cam1 is not None
        self._left, self._right = rig.cam0, rig.cam1
        self._T_right_left = se3.inverse(rig.T_cam0_cam1)
        self._config = config
        self._baseline_m = float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))
        R, t = self._T_right_left[:3, :3], self._T_right_left[:3, 3]
        self._fundamental = np.linalg.inv(self._right.K).T @ se3.hat(t) @ R @ np.linalg.inv(self._left.K)

    def inverse_depth(self, frame: Frame, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Triangulate every point with its match in the right image; sigma from the disparity's."""
        unknown = np.full(len(points), np.nan)
        if frame.image_right is None or len(points) == 0:
            return unknown, unknown.copy()
        left, right = grey_of(frame.image), grey_of(frame.image_right)
        there, ok = self._match(left, right, np.asarray(points, np.float32))

        ideal_left, ideal_right = self._left.undistort(points), self._right.undistort(there)
        lines = np.column_stack([ideal_left, np.ones(len(points))]) @ self._fundamental.T
        distance = np.abs((lines[:, :2] * ideal_right).sum(1) + lines[:, 2]) / np.hypot(lines[:, 0], lines[:, 1])
        inverse, parallax_px = self._triangulate(points, there)
        c = self._config
        with np.errstate(invalid="ignore"):
            ok &= (distance < EPIPOLAR_PX) & (parallax_px > c.min_disparity_px) & (inverse > 0) & (inverse < 1 / c.depth_min_m)
        sigma = c.disparity_sigma_px / (self._left.fx * self._baseline_m)
        return np.where(ok, inverse, np.nan), np.where(ok, sigma, np.nan)

    def _match(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Match along coarse-to-fine flow, from infinity and, where that fails, from a close guess."""
        rays = self._left.rays(points)
        guesses = [self._right.project(se3.transform(self._T_right_left, rays * z)) for z in (1e6, 25 * self._baseline_m)]
        settings = {"window_px": 21, "levels": 4, "round_trip_px": self._config.flow_round_trip_px}
        there, ok = flow.track(left, right, points, guesses[0].astype(np.float32), **settings)  # type: ignore[arg-type]
        if not ok.all():
            again, ok_again = flow.track(left, right, points[~ok], guesses[1][~ok].astype(np.float32), **settings)  # type: ignore[arg-type]
            there[~ok] = again
            ok = ok.copy()
            ok[~ok] = ok_again
        return there, ok

    def _triangulate(
        self, points: NDArray[np.floating], there: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse depth in the left camera (N,) and the parallax to infinity in pixels (N,)."""
        rays_left, rays_right = self._left.rays(points), self._right.rays(there)
        R, t = self._T_right_left[:3, :3], self._T_right_left[:3, 3]
        turned = rays_left @ R.T
        # z * turned + t lies on the right ray; the cross product with that ray leaves a + b / z = 0.
        a, b = np.cross(rays_right, turned), np.cross(rays_right, t[None])
        inverse = -(a * b).sum(1) / np.maximum((b * b).sum(1), 1e-18)
        at_infinity = turned[:, :2] / turned[:, 2:]
        parallax = np.linalg.norm(rays_right[:, :2] - at_infinity, axis=1) * self._right.fx
        return inverse, parallax


def make_depth_sensor(rig: Rig, mode: Mode, config: FrontendConfig) -> DepthSensor:
    """Return the depth sensor of a mode."""
    if mode is Mode.RGBD:
        return DepthImage(rig, config)
    if mode is Mode.STEREO:
        return StereoPair(rig, config)
    return NoDepth()

