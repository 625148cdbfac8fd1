"""What a keyframe's depth image says of the surfaces before its camera: points with normals, in the camera's frame."""

import logging
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera
from seamark.frontend.keyframe_depth import DepthError, decode_depth
from seamark.frontend.types import Keyframe

logger = logging.getLogger(__name__)

Matrix = NDArray[np.float64]

WINDOW: Final = 7  # pixels
LEAST_KNOWN: Final = 0.7  # of a window
BEND: Final = 0.015  # rms of the inverse depth about a plane, relative: more is an edge, a corner or a bush


@dataclass(frozen=True, eq=False)
class Surface:
    """The surfaces that one camera sees, on a grid of ``shape`` (h, w), a pixel for a square of ``block`` pixels.

    ``inverse_depth`` (h * w,) in 1/m is 0 where unknown. ``points`` and ``normals`` (h * w, 3) are NaN where unknown;
    normals are of unit length and point away from the camera.
    """

    camera: Camera
    shape: tuple[int, int]
    block: int
    inverse_depth: NDArray[np.float64]
    points: Matrix
    normals: Matrix

    def sample(self, most: int) -> NDArray[np.intp]:
        """Return up to ``most`` indices of points with a normal, spread evenly over the image."""
        known = np.flatnonzero(np.isfinite(self.normals[:, 0]))
        return known if len(known) <= most else known[np.linspace(0, len(known) - 1, most).astype(np.intp)]

    def cells(self, pixels: Matrix) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the index of the grid (N,) in which each pixel (N, 2) lies, as seen, and whether it lies in any."""
        h, w = self.shape
        grid = np.rint((pixels - (self.block - 1) / 2) / self.block)
        inside: NDArray[np.bool_] = np.asarray(((grid >= 0) & (grid < (w, h))).all(axis=1))
        column, row = np.where(inside[:, None], grid, 0).astype(np.intp).T
        return row * w + column, inside


def surface_of(keyframe: Keyframe) -> Surface | None:
    """Return the surfaces of a keyframe, None where it carries no depth, or one that is not of its camera."""
    camera = keyframe.camera
    if camera is None or not keyframe.depth or not keyframe.metric:
        return None
    try:
        inverse = decode_depth(keyframe.depth).astype(np.float64)
    except DepthError as error:
        logger.warning("keyframe %d: %s", keyframe.id, error)
        return None
    block = camera.width // inverse.shape[1]
    if block == 0 or (camera.height // block, camera.width // block) != inverse.shape or min(inverse.shape) < 3:
        logger.warning("keyframe %d: its depth of %s pixels is not of its camera", keyframe.id, inverse.shape)
        return None
    return surface(inverse, camera, block)


def surface(inverse_depth: Matrix, camera: Camera, block: int) -> Surface:
    """Return the surfaces of an inverse depth image (h, w) in 1/m, 0 where unknown."""
    h, w = inverse_depth.shape
    rows, columns = np.indices((h, w)).reshape(2, -1)
    rays = camera.rays(np.column_stack([columns, rows]) * block + (block - 1) / 2)
    with np.errstate(divide="ignore"):
        depth = np.where(inverse_depth > 0, 1 / inverse_depth, np.nan)
    normals = _normals(inverse_depth, rays.reshape(h, w, 3)).reshape(-1, 3)
    return Surface(camera, (h, w), block, inverse_depth.reshape(-1), rays * depth.reshape(-1, 1), normals)


def _normals(inverse_depth: Matrix, rays: Matrix) -> Matrix:
    """Return the normals (h, w, 3) of the planes that fit the square of WINDOW pixels about each, NaN where none does.

    A plane is linear in inverse depth over the rays: n . ray = d / z. Squares are large, because noise in a normal
    looks like knowledge of the directions along the surface: on a wall it would claim what a wall cannot know.
    """
    known = (inverse_depth > 0).astype(np.float64)

    def mean(image: Matrix) -> Matrix:
        return np.asarray(cv2.boxFilter(image * known, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT))

    share = mean(known)
    u, v, d = rays[:, :, 0], rays[:, :, 1], inverse_depth
    count = np.maximum(share, 1e-9)
    mu, mv, md = (mean(image) / count for image in (u, v, d))
    uu, uv, vv = mean(u * u) / count - mu * mu, mean(u * v) / count - mu * mv, mean(v * v) / count - mv * mv
    ud, vd, dd = mean(u * d) / count - mu * md, mean(v * d) / count - mv * md, mean(d * d) / count - md * md
    determinant = np.maximum(uu * vv - uv * uv, 1e-18)
    a, b = (vv * ud - uv * vd) / determinant, (uu * vd - uv * ud) / determinant
    left = np.sqrt(np.maximum(dd - a * ud - b * vd, 0))
    normals = np.stack([a, b, md - a * mu - b * mv], axis=2)
    flat = (share > LEAST_KNOWN) & (left < BEND * d) & (np.abs(md + a * (u - mu) + b * (v - mv) - d) < 2 * BEND * d)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    return np.where(flat[:, :, None], normals, np.nan)
