"""Two views of a moving camera: relative pose, parallax and triangulation."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera

ESSENTIAL_PX = 1.0


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


def initialise(
    pixels_first: NDArray[np.float64],
    pixels_second: NDArray[np.float64],
    camera: Camera,
    *,
    min_parallax_px: float,
    min_landmarks: int,
    min_angle_deg: float,
) -> TwoView | str:
    """Build a first map from two views, or say in a word why it is not yet safe.

    Ideal pixels (N, 2) of the same corners. An essential matrix (MAGSAC++, Barath 2020) gives the motion; it is
    refused for little parallax after the rotation is taken out (pure rotation), for few points in front of both
    cameras or with a wide enough angle. The median depth becomes 1.
    """
    if len(pixels_first) < min_landmarks:
        return "few_tracks"
    E, mask = cv2.findEssentialMat(
        pixels_first, pixels_second, camera.K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=ESSENTIAL_PX
    )
    if E is None or E.shape != (3, 3) or mask is None:
        return "no_essential_matrix"
    inliers = mask.reshape(-1).astype(bool)
    if inliers.sum() < min_landmarks:
        return "few_inliers"
    _, R, t, _ = cv2.recoverPose(E, pixels_first, pixels_second, camera.K, mask=mask.copy())
    T_first_second = se3.inverse(se3.make(R, t))
    rays_first = normalised_rays(pixels_first, camera)
    rays_second = normalised_rays(pixels_second, camera)
    parallax = rotation_compensated_parallax(T_first_second[:3, :3], pixels_first, rays_second, camera)
    if float(np.median(parallax[inliers])) < min_parallax_px:
        return "little_parallax"
    points, angle = triangulate(np.eye(4), rays_first, T_first_second, rays_second)
    good = inliers & np.isfinite(points[:, 0]) & (angle > np.deg2rad(min_angle_deg))
    if good.sum() < max(min_landmarks, 0.5 * inliers.sum()):
        return "few_landmarks"
    scale = 1 / float(np.median(points[good, 2]))
    T_first_second[:3, 3] *= scale
    return TwoView(T_first_second, np.where(good[:, None], points * scale, np.nan))


def normalised_rays(pixels: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return rays (N, 3) with z = 1 of ideal pixels (N, 2)."""
    return np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
