"""Cameras and rigs: intrinsics, distortion, projection, the right eye."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError

DISTORTION_LENGTHS = (0, 4, 5, 8)


class CalibrationError(SeamarkError):
    """A calibration is malformed or contradicts the images."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV's radial-tangential distortion.

    ``fx fy cx cy`` are pixels for an image of ``width`` x ``height``; ``distortion`` has 0, 4, 5 or 8 numbers in
    OpenCV's order (k1 k2 p1 p2 k3 k4 k5 k6). Raises CalibrationError for anything else.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.distortion) not in DISTORTION_LENGTHS:
            raise CalibrationError(f"distortion has {len(self.distortion)} numbers; 0, 4, 5 or 8 are possible")
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.all(np.isfinite(values)) or min(self.fx, self.fy) <= 0 or min(self.width, self.height) <= 0:
            raise CalibrationError(
                f"calibration needs finite numbers, positive focal lengths and a positive size: {self}"
            )

    @cached_property
    def K(self) -> NDArray[np.float64]:
        """Return the (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @cached_property
    def distorted(self) -> bool:
        """Return whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def undistort(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map pixels (N, 2) as seen to pixels of the ideal pinhole camera with the same K."""
        points64 = np.ascontiguousarray(points, np.float64).reshape(-1, 2)
        if not self.distorted or len(points64) == 0:
            return points64
        coefficients = np.array(self.distortion, np.float64)
        return cv2.undistortPoints(points64, self.K, coefficients, P=self.K).reshape(-1, 2)

    def rays(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map pixels (N, 2) as seen to rays (N, 3) with z = 1 in the camera frame."""
        ideal = self.undistort(points)
        return np.column_stack(
            [(ideal[:, 0] - self.cx) / self.fx, (ideal[:, 1] - self.cy) / self.fy, np.ones(len(ideal))]
        )

    def project_ideal(self, points_cam: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project (N, 3) points of the camera frame to ideal (undistorted) pixels (N, 2); z must be positive."""
        points64 = np.asarray(points_cam, np.float64).reshape(-1, 3)
        normalised = points64[:, :2] / points64[:, 2:]
        return normalised * (self.fx, self.fy) + (self.cx, self.cy)

    def project(self, points_cam: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project (N, 3) points of the camera frame to pixels as seen (distorted), (N, 2); z must be positive."""
        if not self.distorted:
            return self.project_ideal(points_cam)
        points64 = np.ascontiguousarray(points_cam, np.float64).reshape(-1, 3)
        if len(points64) == 0:
            return np.zeros((0, 2))
        zero = np.zeros(3)
        return cv2.projectPoints(points64, zero, zero, self.K, np.array(self.distortion))[0].reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of one sensor.

    ``cam0`` is the camera of ``Frame.image``. For stereo ``cam1`` and ``T_cam0_cam1`` (4, 4), which maps the right
    camera's frame into the left one's. ``depth_factor`` is raw units per metre of an integer depth image.
    """

    cam0: Camera
    cam1: Camera | None = None
    T_cam0_cam1: NDArray[np.float64] | None = None
    depth_factor: float = 1000.0

    def __post_init__(self) -> None:
        if (self.cam1 is None) != (self.T_cam0_cam1 is None):
            raise CalibrationError("a stereo rig needs both cam1 and T_cam0_cam1")
        if not self.depth_factor > 0:
            raise CalibrationError(f"depth_factor must be positive, not {self.depth_factor}")
