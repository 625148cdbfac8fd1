"""What follows from exact depth and poses: optical flow, what hides what, and which frames show the same surfaces.

Two frames show the same place where they share visible surface, as in A. Pion et al., "Benchmarking image retrieval for
visual localization", 3DV 2020 (frustum overlap) but with occlusion: distance alone calls two sides of a wall one place.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth.figures import FIRST_PERSON
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Array = NDArray[np.float64]
DepthImage = NDArray[np.floating]
NEAR_M = 0.05
GRID = (24, 32)  # points of a frame that stand for its surface
TOLERANCE_M, TOLERANCE_SHARE = 0.05, 0.03  # of depth, for two views of one point
SCALE_LIMIT = 3.0  # seen this much nearer or farther a surface is not recognised
SAME_PLACE_SHARE = 0.25
UNRELATED_SHARE = 0.02


def _pixels(camera: Camera) -> Array:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)


def flow(
    depth: DepthImage,
    camera: Camera,
    T_world_a: Array,
    T_world_b: Array,
    labels: NDArray[np.uint8] | None = None,
    displacements: Mapping[int, Array] | None = None,
) -> NDArray[np.float32]:
    """Return where the pixels of frame a are in frame b, minus where they were: (H, W, 2) float32 px.

    ``depth`` (H, W) is of frame a in m along the optical axis. NaN where it is unknown (0, not finite) or the point is
    behind camera b; pixels that another surface hides in b have their flow nevertheless (``visible`` tells them).

    Without ``labels`` (H, W) of frame a everything counts as standing still. With them what moves by itself has its own
    flow: ``displacements`` gives by label the motion (4, 4) of its points in the world from a to b, as
    ``people.People.displacements`` does for labels=2; NaN where a label from figures.FIRST_PERSON on is not among them.
    """
    if depth.shape != (camera.height, camera.width):
        raise SeamarkError(f"depth is {depth.shape}, the camera {camera.width}x{camera.height}")
    pixels = _pixels(camera)
    z = depth.reshape(-1).astype(np.float64)
    known = np.isfinite(z) & (z > 0)
    if labels is not None:
        if labels.shape != depth.shape:
            raise SeamarkError(f"labels are {labels.shape}, depth is {depth.shape}")
        moving = np.ones(256, np.bool_)
        moving[:FIRST_PERSON] = moving[list(displacements or {})] = False
        known &= ~moving[labels.reshape(-1)]  # how these move is not known
    world = se3.transform(T_world_a, camera.rays(pixels[known]) * z[known, None])
    if labels is not None:
        shown = labels.reshape(-1)[known]
        for label, T in (displacements or {}).items():
            world[shown == label] = se3.transform(T, world[shown == label])
    moved = se3.transform(se3.inverse(T_world_b), world)
    ahead = moved[:, 2] > NEAR_M
    out = np.full((len(z), 2), np.nan, np.float32)
    where = np.flatnonzero(known)[ahead]
    out[where] = camera.project(moved[ahead]) - pixels[where]
    return out.reshape(*depth.shape, 2)


def visible(
    depth_a: DepthImage, depth_b: DepthImage, camera: Camera, T_world_a: Array, T_world_b: Array
) -> NDArray[np.bool_]:
    """Return (H, W) True where what frame a sees at a pixel is seen by frame b too, inside its image and not hidden."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    points = np.column_stack([columns.ravel(), rows.ravel()])
    seen = np.zeros(depth_a.size, np.bool_)
    z = depth_a.reshape(-1).astype(np.float64)
    known = np.isfinite(z) & (z > 0)
    world = se3.transform(T_world_a, camera.rays(points[known].astype(np.float64)) * z[known, None])
    seen[known] = _seen(world, depth_b, camera, T_world_b)[0]
    return seen.reshape(depth_a.shape)


def _seen(world: Array, depth: DepthImage, camera: Camera, T_world_cam: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which points (N, 3) of the world a frame sees, and their depth (N,) in it."""
    points = se3.transform(se3.inverse(T_world_cam), world)
    z = points[:, 2]
    seen = z > NEAR_M
    if not seen.any():
        return seen, z
    whole = np.rint(camera.project(points[seen])).astype(np.int64)
    inside = np.all((whole >= 0) & (whole < (camera.width, camera.height)), axis=1)
    seen[seen] = inside
    measured = depth[whole[inside, 1], whole[inside, 0]].astype(np.float64)
    near = np.abs(measured - z[seen]) < TOLERANCE_M + TOLERANCE_SHARE * z[seen]
    seen[seen] = near & (measured > 0)
    return seen, z


@dataclass(frozen=True, eq=False)
class PlaceTruth:
    """Which frames show the same place.

    ``shares`` (N, N): entry (i, j) is how much of the surface that frame i sees is seen by frame j too, from a distance
    that differs by less than SCALE_LIMIT; the diagonal is 1.
    """

    shares: NDArray[np.float32]

    @property
    def overlap(self) -> NDArray[np.float32]:
        """Return (N, N), symmetric: the smaller of both directions."""
        return np.minimum(self.shares, self.shares.T)

    def same_place(self, least_share: float = SAME_PLACE_SHARE) -> NDArray[np.bool_]:
        """Return (N, N) True where two frames share at least that much of what they see."""
        return np.asarray(self.overlap >= least_share)

    def unrelated(self, most_share: float = UNRELATED_SHARE) -> NDArray[np.bool_]:
        """Return (N, N) True where neither frame sees more than that of what the other sees: a match there is false.

        Between the two lie pairs that may be matched and need not be.
        """
        return np.asarray(np.maximum(self.shares, self.shares.T) <= most_share)


def place_truth(depths: Iterable[DepthImage], T_world_cam: Sequence[Array] | Array, camera: Camera) -> PlaceTruth:
    """Return the place truth of frames with depth (H, W) in m, taken by one camera from T_world_cam (N, 4, 4).

    A grid of GRID points stands for what a frame sees. Images without distortion and with it are treated alike, because
    points go through the model of the camera. Raises SeamarkError where counts or sizes differ.
    """
    small: list[NDArray[np.float32]] = []
    clouds: list[Array] = []
    ranges: list[Array] = []
    scale = 4 if min(camera.width, camera.height) >= 4 * GRID[0] else 1
    rows = np.linspace(0, camera.height - 1, GRID[0] + 2)[1:-1].round().astype(int)
    columns = np.linspace(0, camera.width - 1, GRID[1] + 2)[1:-1].round().astype(int)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels.astype(np.float64))
    for depth in depths:
        if len(clouds) == len(T_world_cam):
            raise SeamarkError(f"there are more depth images than the {len(T_world_cam)} poses")
        if depth.shape != (camera.height, camera.width):
            raise SeamarkError(f"depth is {depth.shape}, the camera {camera.width}x{camera.height}")
        z = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        known = np.isfinite(z) & (z > 0)
        clouds.append(se3.transform(T_world_cam[len(clouds)], rays[known] * z[known, None]))
        ranges.append(z[known])
        small.append(np.ascontiguousarray(depth[::scale, ::scale], np.float32))
    if len(clouds) < len(T_world_cam):
        raise SeamarkError(f"there are {len(clouds)} depth images for {len(T_world_cam)} poses")
    coarse = _coarse(camera, scale)
    shares = np.eye(len(clouds), dtype=np.float32)
    for i, (cloud, own) in enumerate(zip(clouds, ranges, strict=True)):
        for j, depth in enumerate(small):
            if i != j and len(cloud):
                seen, z = _seen(cloud, depth, coarse, T_world_cam[j])
                ratio = z / own
                shares[i, j] = np.mean(seen & (ratio < SCALE_LIMIT) & (ratio > 1 / SCALE_LIMIT))
    return PlaceTruth(shares)


def _coarse(camera: Camera, scale: int) -> Camera:
    """Return the camera of the picture made of every ``scale``-th pixel, the first one included."""
    height, width = -(-camera.height // scale), -(-camera.width // scale)
    fx, fy, cx, cy = (number / scale for number in (camera.fx, camera.fy, camera.cx, camera.cy))
    return Camera(width, height, fx, fy, cx, cy, camera.distortion)


def epipolar_distances(points_a: Array, points_b: Array, camera: Camera, T_a_b: Array) -> Array:
    """Return how far (N,) px, the larger of both images, pixels (N, 2) as seen are from each other's epipolar lines.

    ``T_a_b`` must move, else there are no such lines: raises SeamarkError.
    """
    if np.linalg.norm(T_a_b[:3, 3]) < 1e-9:
        raise SeamarkError("two cameras in one place have no epipolar lines")
    K_inverse = np.linalg.inv(camera.K)
    F = K_inverse.T @ se3.hat(T_a_b[:3, 3]) @ T_a_b[:3, :3] @ K_inverse
    a = cv2.convertPointsToHomogeneous(camera.undistort(points_a)).reshape(-1, 3)
    b = cv2.convertPointsToHomogeneous(camera.undistort(points_b)).reshape(-1, 3)
    in_a, in_b = b @ F.T, a @ F
    product = np.abs(np.sum(a * in_a, axis=1))
    lengths = np.minimum(np.linalg.norm(in_a[:, :2], axis=1), np.linalg.norm(in_b[:, :2], axis=1))
    return np.asarray(product / np.maximum(lengths, 1e-12))
