"""How landmarks are seen: whitened errors of pixels and inverse depths, and how they change with pose and landmark."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera

HUBER = 1.345


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


def discount(shift: NDArray[np.float64], *rows: NDArray[np.float64]) -> None:
    """Whiten pixel rows (N, 2, ...), in place, whose covariance is 1 + shift shift^T."""
    square = (shift * shift).sum(axis=1)
    share = np.where(square > 1e-12, (1 - 1 / np.sqrt(1 + square)) / np.maximum(square, 1e-12), 0)
    for row in rows:
        flat = row[..., None] if row.ndim == 2 else row
        along = np.einsum("ni,nij->nj", shift, flat) * share[:, None]
        flat -= shift[:, :, None] * along[:, None]
