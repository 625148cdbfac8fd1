"""Where depth comes from: the one difference between mono, stereo and RGB-D.

Every sensor answers with the inverse depth (1/m) of points and its standard deviation, NaN where it knows nothing:
inverse depth is what both a disparity and a triangulation measure, and its noise stays Gaussian at long range.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import flow, se3
from seamark.frontend.camera import CalibrationError
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import grey_of
from seamark.frontend.patches import align_along
from seamark.frontend.pyramid import Pyramid, pyramid_of
from seamark.frontend.types import Frame, Mode, Rig

WINDOW_PX, LEVELS = 21, 4  # of the flow across a pair, whatever that between frames is
EPIPOLAR_PX = 1.5
MAX_REFINEMENT_PX = 2.5
MIN_CORRELATION = 0.8
MIN_READINGS = 3  # of 9: registered depth images are full of single-pixel holes
EDGE_SPREAD = 0.05  # relative depth range in a 3x3 neighbourhood that marks a depth edge


class DepthSensor(Protocol):
    """Gives inverse depths of pixels of ``Frame.image``.

    A sensor keeps nothing between calls: the tracker and the keyframe thread ask the same one at the same time.
    ``systematic_sigma`` (1/m) is how far readings may be wrong in the same way in every frame, 0 for not at all.
    """

    systematic_sigma: float

    def inverse_depth(
        self, frame: Frame, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and its sigma, each (N,) in 1/m, NaN where unknown, for pixels (N, 2) as seen."""
        ...


class NoDepth:
    """Mono: depth comes from motion only."""

    systematic_sigma = 0.0

    def inverse_depth(
        self, frame: Frame, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all unknown."""
        return np.full(len(points), np.nan), np.full(len(points), np.nan)


class DepthImage:
    """RGB-D: the registered depth image, the median of 3x3 pixels, without points on depth edges."""

    systematic_sigma = 0.0

    def __init__(self, rig: Rig, config: FrontendConfig) -> None:
        self._depth_factor = rig.depth_factor
        self._config = config

    def inverse_depth(
        self, frame: Frame, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return inverse depth and sigma after the sensor's noise model (sigma_z = floor + c z^2, Khoshelham 2012)."""
        unknown = np.full(len(points), np.nan)
        if frame.depth is None or len(points) == 0:
            return unknown, unknown.copy()
        depth = frame.depth
        height, width = depth.shape
        x = np.clip(np.rint(points[:, 0]).astype(int), 1, width - 2)
        y = np.clip(np.rint(points[:, 1]).astype(int), 1, height - 2)
        row = np.arange(-1, 2) * width
        offsets = (row[:, None] + np.arange(-1, 2)).reshape(-1)
        around = depth.reshape(-1)[(y * width + x)[:, None] + offsets].astype(np.float64)
        if depth.dtype == np.uint16:
            around /= self._depth_factor
        usable = np.isfinite(around) & (around > 0)
        readings = usable.sum(axis=1)
        around = np.sort(np.where(usable, around, np.inf), axis=1)
        place = np.arange(len(points))
        z = around[place, np.maximum(readings - 1, 0) // 2]
        c = self._config
        valid = (readings >= MIN_READINGS) & (z > c.depth_min_m) & (z < c.depth_max_m)
        z = np.where(valid, z, np.nan)
        last = around[place, np.maximum(readings - 1, 0)]
        spread = np.where(valid, last, 0) - np.where(valid, around[:, 0], 0)
        valid &= spread < np.maximum(EDGE_SPREAD * z, 4 * (c.depth_sigma_floor_m + c.depth_sigma_per_m2 * z**2))
        z = np.where(valid, z, np.nan)
        sigma_z = c.depth_sigma_floor_m + c.depth_sigma_per_m2 * z**2
        return 1 / z, sigma_z / z**2


class StereoPair:
    """Stereo: Lucas-Kanade from the left to the right image with a left-right check and the epipolar constraint."""

    def __init__(self, rig: Rig, config: FrontendConfig) -> None:
        if rig.cam1 is None or rig.T_cam0_cam1 is None:
            raise CalibrationError("mode stereo needs a calibration of both cameras")
        self._left, self._right = left, right = rig.cam0, rig.cam1
        if (left.width, left.height) != (right.width, right.height):
            raise CalibrationError(
                "mode stereo needs images of one size, "
                f"not {left.width} x {left.height} and {right.width} x {right.height}"
            )
        self._T_right_left = se3.inverse(rig.T_cam0_cam1)
        self._config = config
        self._baseline_m = float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))
        self.systematic_sigma = config.disparity_systematic_px / (rig.cam0.fx * self._baseline_m)
        R, t = self._T_right_left[:3, :3], self._T_right_left[:3, 3]
        self._essential = se3.hat(t) @ R

    def inverse_depth(
        self, frame: Frame, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Triangulate every point with its match in the right image; sigma from the disparity's."""
        unknown = np.full(len(points), np.nan)
        if frame.image_right is None or len(points) == 0:
            return unknown, unknown.copy()
        left, right = (pyramid_of(grey_of(image), LEVELS) for image in (frame.image, frame.image_right))
        c = self._config
        there, ok = self._match(left, right, np.asarray(points, np.float32))
        inverse, distance = self._triangulate(points, there)
        ok &= (distance < EPIPOLAR_PX) & (inverse > 0) & (inverse < 1 / c.depth_min_m)

        chosen = np.flatnonzero(ok)
        on_curve, along = self._epipolar_curve(points[chosen], inverse[chosen])
        refined, correlation = align_along(left, right, points[chosen], on_curve, along)
        inverse[chosen], distance = self._triangulate(points[chosen], refined)
        stayed = np.linalg.norm(refined - on_curve, axis=1) < MAX_REFINEMENT_PX
        sigma = c.disparity_sigma_px / (self._left.fx * self._baseline_m)
        ok[chosen] = stayed & (correlation > MIN_CORRELATION) & (distance < EPIPOLAR_PX)
        ok &= inverse > c.min_disparity_px / c.disparity_sigma_px * sigma
        return np.where(ok, inverse, np.nan), np.where(ok, sigma, np.nan)

    def _match(
        self, left: Pyramid, right: Pyramid, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Match along coarse-to-fine flow, from infinity and, where that fails, from a close guess."""
        rays = self._left.rays(points)
        guesses = [
            self._right.project(se3.transform(self._T_right_left, rays * z)) for z in (1e6, 25 * self._baseline_m)
        ]
        there, ok = np.zeros((len(points), 2), np.float32), np.zeros(len(points), bool)
        for guess in guesses:
            todo = np.flatnonzero(~ok)
            there[todo], ok[todo] = flow.track(
                left,
                right,
                points[todo],
                guess[todo].astype(np.float32),
                window_px=WINDOW_PX,
                levels=LEVELS,
                round_trip_px=self._config.flow_round_trip_px,
                min_correlation=self._config.flow_min_correlation,
            )
        return there, ok

    def _epipolar_curve(
        self, points: NDArray[np.floating], inverse: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where points (N, 2) of that inverse depth are in the right image, and the curve's unit direction
        there.
        """
        rays = self._left.rays(points)
        here, beyond = (
            self._right.project(rays @ self._T_right_left[:3, :3].T + self._T_right_left[:3, 3] * rho[:, None])
            for rho in (inverse, inverse + 0.01 / self._baseline_m)
        )
        step = beyond - here
        return here, step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)

    def _triangulate(
        self, points: NDArray[np.floating], there: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse depth in the left camera (N,) and the distance to the epipolar line in ideal pixels
        (N,).
        """
        rays_left, rays_right = self._left.rays(points), self._right.rays(there)
        R, t = self._T_right_left[:3, :3], self._T_right_left[:3, 3]
        # z * (R ray_left) + t lies on the right ray; the cross product with that ray leaves a + b / z = 0.
        a, b = np.cross(rays_right, rays_left @ R.T), np.cross(rays_right, t[None])
        inverse = -(a * b).sum(1) / np.maximum((b * b).sum(1), 1e-18)
        lines = rays_left @ self._essential.T
        distance = np.abs((lines * rays_right).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
        return inverse, distance * self._right.fx


def make_depth_sensor(rig: Rig, mode: Mode, config: FrontendConfig) -> DepthSensor:
    """Return the depth sensor of a mode; raises CalibrationError where the rig is not one for it."""
    if mode is Mode.RGBD:
        return DepthImage(rig, config)
    if mode is Mode.STEREO:
        return StereoPair(rig, config)
    return NoDepth()
