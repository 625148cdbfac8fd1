"""Two views of a moving camera: parallax and triangulation; first_map.py has the motion between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera


@dataclass(frozen=True, eq=False)
class TwoView:
    """A first map: ``T_first_second`` with unit-median-depth scale, ``landmarks`` (N, 3) in the first camera, NaN
    where bad.
    """

    T_first_second: NDArray[np.float64]
    landmarks: NDArray[np.float64]


def triangulate(
    T_world_a: NDArray[np.float64],
    rays_a: NDArray[np.float64],
    T_world_b: NDArray[np.float64],
    rays_b: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intersect rays (N, 3) of two cameras; poses are (4, 4) or one per ray (N, 4, 4).

    Returns the midpoints (N, 3) in the world, NaN behind either camera or for parallel rays, and the angles (N,) in
    radians between the rays.
    """
    a = np.einsum("...ij,...j->...i", T_world_a[..., :3, :3], rays_a)
    b = np.einsum("...ij,...j->...i", T_world_b[..., :3, :3], rays_b)
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    origin_a = np.broadcast_to(T_world_a[..., :3, 3], a.shape)
    origin_b = np.broadcast_to(T_world_b[..., :3, 3], b.shape)
    between = origin_b - origin_a
    cosine = (a * b).sum(-1)
    along_a, along_b = (a * between).sum(-1), (b * between).sum(-1)
    denominator = 1 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_a - cosine * along_b) / denominator
        r = (cosine * along_a - along_b) / denominator
    good = (denominator > 1e-10) & (s > 0) & (r > 0)
    middle = 0.5 * (origin_a + s[:, None] * a + origin_b + r[:, None] * b)
    middle[~good] = np.nan
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), cosine)
    return middle, angle


def rotation_compensated_parallax(
    R_first_second: NDArray[np.float64],
    pixels_first: NDArray[np.float64],
    rays_second: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Return how far (N,) in pixels points moved beyond what the rotation alone explains."""
    turned = rays_second @ R_first_second.T
    turned[:, 2] = np.maximum(turned[:, 2], 1e-3)
    return np.linalg.norm(camera.project_ideal(turned) - pixels_first, axis=1)


def normalised_rays(pixels: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return rays (N, 3) with z = 1 of ideal pixels (N, 2)."""
    return np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
