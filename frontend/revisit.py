"""Landmarks of earlier keyframes, seen again: a camera that stays in a room must not drift.

Keyframes that leave the window are kept for a while with their images. When the camera looks the same way again, their
landmarks are projected, and their patches are found by Lucas-Kanade around where they should be. What is found becomes
tracks again, and the old keyframe, held still, takes part in the next adjustment of the window: odometry is drawn to
where it was, smoothly, over the keyframes of the window.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import flow, se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.kernels import native
from seamark.frontend.pyramid import Pyramid
from seamark.frontend.tracks import Tracks
from seamark.frontend.window import WindowKeyframe

LEVELS = 2  # of the pyramid: enough for revisit_search_px
CROWDED_PX = 3.0  # nearer to a live track than this it is the same corner


def worth_revisiting(
    archive: Sequence[WindowKeyframe], T_odom_cam: NDArray[np.float64], depth: float, config: FrontendConfig
) -> list[WindowKeyframe]:
    """Return the archived keyframes that look most nearly as the camera does now, the nearest first.

    ``depth`` is the median depth of what is seen: a step aside counts relative to it, one unit as much as one radian.
    """
    if not archive or not depth > 0:
        return []
    poses = np.stack([old.T_odom_cam for old in archive])
    angle = se3.rotation_angle(np.swapaxes(poses[:, :3, :3], 1, 2) @ T_odom_cam[:3, :3])
    step = np.linalg.norm(poses[:, :3, 3] - T_odom_cam[:3, 3], axis=1) / depth
    near = (angle < np.deg2rad(config.revisit_angle_deg)) & (step < config.revisit_step)
    order = np.argsort(angle + step, kind="stable")
    return [archive[k] for k in order if near[k]][: config.revisit_keyframes]


def find_again(
    old: WindowKeyframe,
    positions: NDArray[np.float64],
    image: Pyramid,
    T_odom_cam: NDArray[np.float64],
    camera: Camera,
    live: Tracks,
    config: FrontendConfig,
) -> Tracks:
    """Find landmarks of an old keyframe in the current image.

    ``positions`` (M, 3) are those of ``old.track_ids`` in the odometry frame, NaN where unknown. Returns the tracks
    that were found, none of which is among the ``live`` ones or on top of one.
    """
    in_cam = se3.transform(se3.inverse(T_odom_cam), positions)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero((in_cam[:, 2] > 0) & ~np.isin(old.track_ids, live.ids))
    expected = camera.project(in_cam[rows]).astype(np.float32)
    margin = config.flow_window_px // 2
    size = np.array([camera.width, camera.height])
    inside = ((expected > margin) & (expected < size - 1 - margin)).all(axis=1)
    rows, expected = rows[inside], expected[inside]
    if len(rows) == 0:
        return Tracks.none()
    there, ok = flow.track(
        old.image,
        image,
        old.seen[rows],
        expected,
        window_px=config.flow_window_px,
        levels=LEVELS,
        round_trip_px=0.5 * config.flow_round_trip_px,
        min_correlation=config.flow_min_correlation,
        reach_px=config.revisit_search_px,
    )
    ok &= np.linalg.norm(there - expected, axis=1) < config.revisit_search_px
    ok &= native.apart(there, live.pixels, CROWDED_PX, to_each_other=False)
    return Tracks(old.track_ids[rows[ok]], there[ok])
