"""Landmarks from parallax: where the newest keyframe and an earlier one of the window see the same track."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera
from seamark.frontend.two_view import normalised_rays, triangulate
from seamark.frontend.window import WindowKeyframe

MIN_DEPTH = 1e-3


def triangulate_tracks(
    newest: WindowKeyframe,
    earlier: Sequence[WindowKeyframe],
    todo: NDArray[np.bool_],
    camera: Camera,
    *,
    min_angle_rad: float,
    threshold_px: float,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Triangulate tracks of the newest keyframe, those of ``todo`` (M,), each against the first view that will do.

    ``earlier`` begins with the oldest view, which has the widest angle. A view will do when the rays meet in front of
    both cameras, at ``min_angle_rad`` at least, and the point is seen within ``threshold_px`` in both. Returns rows
    (L,) of the newest keyframe, positions (L, 3) in the odometry frame and angles (L,) in radians.
    """
    rows, view, there = _pairs(newest, earlier, todo)
    if len(rows) == 0:
        return rows, np.zeros((0, 3)), np.zeros(0)
    poses = np.stack([k.T_odom_cam for k in earlier])[view]
    pixels = newest.pixels[rows]
    points, angle = triangulate(
        poses, normalised_rays(there, camera), newest.T_odom_cam, normalised_rays(pixels, camera)
    )
    good = np.isfinite(points[:, 0]) & (angle > min_angle_rad)
    points = np.where(good[:, None], points, 0)
    for T, seen in ((poses, there), (newest.T_odom_cam[None], pixels)):
        in_cam = np.einsum("nji,nj->ni", np.broadcast_to(T, poses.shape)[:, :3, :3], points - T[:, :3, 3])
        good &= in_cam[:, 2] > MIN_DEPTH
        safe = np.where(good[:, None], in_cam, [0, 0, 1])
        good &= np.linalg.norm(camera.project_ideal(safe) - seen, axis=1) < threshold_px
    chosen = np.flatnonzero(good)
    _, first = np.unique(rows[chosen], return_index=True)  # of each track the oldest view that will do
    chosen = chosen[first]
    return rows[chosen], points[chosen], angle[chosen]


def _pairs(
    newest: WindowKeyframe, earlier: Sequence[WindowKeyframe], todo: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Return where tracks have been seen before: rows (P,) of the newest keyframe, views (P,), ascending, and pixels
    (P, 2) there.
    """
    wanted = np.flatnonzero(todo)
    if len(wanted) == 0 or not earlier:
        return np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2))
    wanted = wanted[np.argsort(newest.track_ids[wanted])]
    ids = newest.track_ids[wanted]
    before = np.concatenate([k.track_ids for k in earlier])
    place = np.minimum(np.searchsorted(ids, before), len(ids) - 1)
    found = np.flatnonzero(ids[place] == before)
    view = np.repeat(np.arange(len(earlier)), [len(k.track_ids) for k in earlier])
    return wanted[place[found]], view[found], np.vstack([k.pixels for k in earlier])[found]
