"""Camera paths as stacks of poses; the world is x forward, y left, z up, the camera x right, y down, z forward."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3

FIRST_STAMP_NS = 1_000_000_000


def look(position: NDArray[np.floating], yaw: float, pitch: float = 0.0, roll: float = 0.0) -> se3.Matrix:
    """Return T_world_cam at ``position`` (3,) m, looking along ``yaw`` (about z), with the nose down by ``pitch``."""
    R = se3.exp_rotation(np.array([0, 0, yaw])) @ se3.exp_rotation(np.array([0, pitch, 0]))
    R = R @ se3.exp_rotation(np.array([roll, 0, 0]))
    return se3.make(R, position) @ se3.T_WORLD_LEVEL_CAM


def stamps(n_frames: int, fps: float) -> NDArray[np.int64]:
    """Return ``n_frames`` stamps (N,) int64 in ns at a rate of ``fps``, starting at one second."""
    since_first: NDArray[np.int64] = np.rint(np.arange(n_frames) * 1e9 / fps).astype(np.int64)
    return FIRST_STAMP_NS + since_first


def circle(n_frames: int, radius: float, height: float, laps: float) -> NDArray[np.float64]:
    """Return ``laps`` anticlockwise laps (N, 4, 4) about the z axis, looking along the tangent, bobbing a little."""
    angles = np.linspace(0, 2 * np.pi * laps, n_frames)
    poses = []
    for a in angles:
        position = np.array([radius * np.cos(a), radius * np.sin(a), height + 0.03 * np.sin(7 * a)])
        poses.append(look(position, a + np.pi / 2, 0.03 * np.sin(5 * a)))
    return np.stack(poses)


def line(n_frames: int, start: NDArray[np.floating], length: float, yaw: float) -> NDArray[np.float64]:
    """Return a straight path (N, 4, 4) along x from ``start`` (3,), looking to ``yaw``."""
    steps = np.linspace(0, length, n_frames)
    sway = np.column_stack([steps, 0.03 * np.sin(3 * steps), np.zeros(n_frames)])
    return np.stack([look(position, yaw) for position in start + sway])


def turn(n_frames: int, centre: NDArray[np.floating], angle: float) -> NDArray[np.float64]:
    """Return a turn on the spot (N, 4, 4) by ``angle``, the camera pivoting about ``centre`` (3,) without offset."""
    return np.stack([look(centre, yaw) for yaw in np.linspace(0, angle, n_frames)])
