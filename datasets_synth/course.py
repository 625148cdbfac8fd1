"""The way along a route as pieces that are driven one after another: drives, turns on the spot, pauses.

A piece is an array (N, 4) of x, y, z (m) and heading (rad) at every TICK_S. Drives start and end at rest and keep to
the speed that bends allow, in a pass forward and one backward, as in E. Velenis, P. Tsiotras, "Minimum-time travel for
a vehicle with acceleration limits", Journal of Optimization Theory and Applications, 2008.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.route import Route

Array = NDArray[np.float64]
TICK_S = 0.02
STEP_M = 0.02
SIGMA_PER_RADIUS = 0.7  # of the Gaussian that cuts a corner no deeper than an arc of that radius would
PAUSE_S = 0.7
RAMP_S = 0.5  # in which a turn on the spot comes to its rate


@dataclass(frozen=True)
class Limits:
    """What a camera may do: speed (m/s), acceleration (m/s^2), turning rate (rad/s)."""

    speed_m_s: float
    acceleration_m_s2: float
    turn_rad_s: float


def smoothed(waypoints: Array, closed: bool, radius_m: float) -> Array:
    """Return the polyline (N, 3) with rounded corners in steps of about STEP_M; a closed one ends where it begins."""
    corners = np.concatenate([waypoints, waypoints[:1]]) if closed else waypoints
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    count = max(8, int(lengths[-1] / STEP_M))
    s = np.linspace(0, lengths[-1], count + 1)
    path = np.stack([np.interp(s, lengths, corners[:, axis]) for axis in range(3)], axis=1)
    sigma = SIGMA_PER_RADIUS * radius_m / (s[1] - s[0])
    reach = min(count, int(4 * sigma) + 1)
    if closed:
        padded = np.concatenate([path[-1 - reach : -1], path, path[1 : 1 + reach]])
    else:  # mirrored through its ends, so that these stay where they are
        padded = np.concatenate([2 * path[0] - path[reach:0:-1], path, 2 * path[-1] - path[-2 : -2 - reach : -1]])
    kernel = cv2.getGaussianKernel(2 * reach + 1, max(sigma, 1e-3)).ravel()
    return np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in range(3)], axis=1)


def lap(route: Route, overlap_m: float = 0.0) -> Array:
    """Return the route (N, 3) from its first waypoint: once round and ``overlap_m`` more, or once along."""
    path = smoothed(route.waypoints, route.closed, route.corner_radius_m)
    more = min(len(path) - 1, int(overlap_m / STEP_M)) if route.closed else 0
    return np.concatenate([path, path[1 : 1 + more]])


def part(path: Array, start: float, end: float) -> Array:
    """Return the part of a path (N, 3) between two shares of its length, 0 to 1."""
    return path[round(start * (len(path) - 1)) : round(end * (len(path) - 1)) + 1]


def aside(path: Array, offset_m: float) -> Array:
    """Return the path (N, 3) moved to its left."""
    tangent = np.gradient(path[:, :2], axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    moved = path.copy()
    moved[:, :2] += offset_m * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return moved


def drive(path: Array, limits: Limits) -> Array:
    """Return the piece that follows ``path`` (N, 3) from rest to rest, looking ahead."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    s = np.concatenate([[0], np.cumsum(lengths)])
    tangent = np.gradient(path[:, :2], axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    bend = np.abs(np.gradient(heading)) / np.maximum(np.gradient(s), 1e-9)
    square = np.minimum(limits.speed_m_s, limits.turn_rad_s / np.maximum(bend, 1e-9)) ** 2
    square = np.minimum(square, limits.acceleration_m_s2 / np.maximum(bend, 1e-9))
    square[[0, -1]] = 0
    gain = 2 * limits.acceleration_m_s2 * s
    square = np.minimum.accumulate(square - gain) + gain
    square = (np.minimum.accumulate((square + gain)[::-1]) - gain[::-1])[::-1]
    v = np.sqrt(np.maximum(square, 0))
    times = np.concatenate([[0], np.cumsum(2 * lengths / np.maximum(v[1:] + v[:-1], 1e-6))])
    ticks = np.arange(int(np.ceil(times[-1] / TICK_S)) + 1) * TICK_S
    columns = [np.interp(ticks, times, column) for column in (*path.T, heading)]
    return np.stack(columns, axis=1)


def turn(before: Array, angle_rad: float, limits: Limits) -> Array:
    """Return the piece that turns on the spot where ``before`` ends, standing still before and after."""
    plateau = max(0.0, abs(angle_rad) / limits.turn_rad_s - RAMP_S)
    times = np.arange(int(np.ceil((plateau + 2 * RAMP_S) / TICK_S)) + 1) * TICK_S
    rate = np.clip(np.minimum(times, plateau + 2 * RAMP_S - times) / RAMP_S, 0, 1)
    turned = np.cumsum(rate) / rate.sum()
    piece = np.repeat(before[-1:], len(turned), axis=0)
    piece[:, 3] += angle_rad * turned
    return np.concatenate([pause(before), piece, pause(piece)])


def pause(before: Array, seconds: float = PAUSE_S) -> Array:
    """Return the piece that stands where ``before`` ends."""
    return np.repeat(before[-1:], max(1, round(seconds / TICK_S)), axis=0)


def joined(pieces: list[Array]) -> Array:
    """Return the pieces as one, with headings that differ by whole turns made continuous."""
    out = [pieces[0]]
    for piece in pieces[1:]:
        next_piece = piece.copy()
        next_piece[:, 3] += 2 * np.pi * np.round((out[-1][-1, 3] - piece[0, 3]) / (2 * np.pi))
        out.append(next_piece)
    return np.concatenate(out)
