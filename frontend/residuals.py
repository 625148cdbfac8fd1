"""How landmarks are seen: whitened errors of pixels and inverse depths, and how they change with the landmark.

The kernels have the same in native/seen.hpp, with what follows from it for poses.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera


@dataclass(frozen=True, eq=False)
class Observations:
    """N landmarks seen by one camera.

    ``landmarks`` (N, 3) in the odometry frame, ``pixels`` (N, 2) ideal (undistorted), ``inverse_depth`` and
    ``inverse_sigma`` (N,) measured by the depth sensor in 1/m, NaN where it knew nothing. ``spread`` (N,) is the
    relative standard deviation of the landmarks' distance from ``origin`` (3,), the place they were seen from; None
    for landmarks known exactly.
    """

    landmarks: NDArray[np.float64]
    pixels: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    inverse_sigma: NDArray[np.float64]
    spread: NDArray[np.float64] | None = None
    origin: NDArray[np.float64] | None = None

    def __getitem__(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "Observations":
        """Select by mask or indices."""
        return Observations(
            self.landmarks[which],
            self.pixels[which],
            self.inverse_depth[which],
            self.inverse_sigma[which],
            None if self.spread is None else self.spread[which],
            self.origin,
        )


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


def shift_of_distance(
    T_odom_cam: NDArray[np.float64],
    in_cam: NDArray[np.float64],
    observations: Observations,
    J_point: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how a change of the landmarks' distances by one sigma moves the whitened pixels (N, 2)."""
    assert observations.spread is not None and observations.origin is not None
    origin = se3.transform(se3.inverse(T_odom_cam), observations.origin[None])
    along = (in_cam - origin) * observations.spread[:, None]
    shift: NDArray[np.float64] = (J_point[:, :2] @ along[:, :, None])[:, :, 0]
    return shift
