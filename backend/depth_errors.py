"""What a sensor's depths err by, measured where the pictures alone know better.

A depth camera errs alike in every frame: its warp is a smooth field over the image, an offset of inverse depth
(Herrera, Kannala and Heikkila, PAMI 2012; Teichman, Miller and Thrun, RSS 2013). Thousands of landmarks would say so
with one voice. A solution that hardly looked at depth has points which their parallax alone has placed: against these
the field is fitted, and what is left is the noise of a reading. A solution that has followed the depths would find them
better than they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

NODES: Final = (6, 5)  # of the field, across and down; bilinear between them
FIELD_SIGMA: Final = 0.02  # expected deviation of the field, per median inverse depth
USUAL: Final = 0.02  # deviation of a reading, per median inverse depth: no reading is taken to be worse
LEAST: Final = 0.003  # nor to be better
UNFIT: Final = 1.5  # times the usual: where so much is left, it is the points that are wrong, for want of parallax
SURE: Final = 1 / 3  # share of the points, those with most parallax, that the noise is measured on
WRONG: Final = 3.0  # deviations from which a reading is not of the point: edges, glass
HUBER: Final = 1.345
ROUNDS: Final = 6


@dataclass(frozen=True, eq=False)
class Depths:
    """Inverse depths (M,) with the field taken out, NaN where a reading is missing or wrong; deviation of one.

    ``warp`` is how large the field is (root mean square), as a share of the median inverse depth.
    """

    inverse: Array
    sigma: float
    warp: float = 0.0


def parallax_sigma(centres: Array, points: Array, track: Rows, sigma_px: float, focal_px: Array) -> Array:
    """Return the standard deviation (M,) of inverse depths that other views of the same track leave.

    Observations by ascending ``track``: ``centres`` (M, 3) of their cameras, ``points`` (M, 3) of their landmarks.
    """
    ray = points - centres
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    ray = ray / np.maximum(distance, 1e-9)
    starts = np.flatnonzero(np.r_[True, np.diff(track) > 0])
    lengths = np.diff(np.r_[starts, len(track)])
    information = np.zeros(len(track))
    for length in np.unique(lengths).tolist():  # tracks of one length at a time
        rows = starts[lengths == length][:, None] + np.arange(length)
        base = centres[rows][:, None] - centres[rows][:, :, None]  # from each view (axis 1) to the others (axis 2)
        along = (base * ray[rows][:, :, None]).sum(axis=3)
        across2 = np.maximum((base**2).sum(axis=3) - along**2, 0.0)
        information[rows] = (across2 * focal_px[rows][:, None] ** 2).sum(axis=2)
    return np.asarray(np.sqrt(2) * sigma_px / np.sqrt(np.maximum(information, 1e-12)))


def measure(
    inverse: Array,
    solved: Array,
    sigma: Array,
    kept: NDArray[np.bool_],
    pixels: Array,
    cameras: Sequence[Camera],
    camera: Rows,
    spread: float,
) -> Depths:
    """Fit the field of each camera and the noise to readings ``inverse`` (M,) against ``solved`` (M,).

    Where the points are worse than depths usually are, these are left as they are. ``sigma`` (M,) is how sure the
    solution is of its inverse depths, ``kept`` (M,) which observations count, ``camera`` (M,) indexes ``cameras``;
    ``spread`` is how much less than it says a single observation knows.
    """
    known = kept & np.isfinite(inverse) & np.isfinite(solved) & (solved > 0)
    if known.sum() < 10:
        return Depths(inverse, USUAL * (float(np.nanmedian(inverse)) if np.isfinite(inverse).any() else 1.0))
    middle = float(np.median(inverse[known]))
    difference = np.where(known, inverse - solved, 0.0)
    sure = known & (sigma <= np.quantile(sigma[known], SURE))
    basis = [(rows, _basis(pixels[rows], cameras[k])) for k, rows in _by_camera(camera, len(cameras))]
    field, noise, left = np.zeros(len(inverse)), USUAL * middle, 0.0
    for _ in range(ROUNDS):
        residual = difference - field
        spread2 = (1.4826 * float(np.median(np.abs(residual[sure])))) ** 2 - float(np.median(sigma[sure] ** 2))
        left = float(np.sqrt(max(spread2, 0.0)))
        noise = float(np.clip(left, LEAST * middle, USUAL * middle))
        deviation = np.hypot(noise, sigma)
        off = np.abs(residual) / deviation
        weight = np.where(known, np.minimum(1.0, HUBER / np.maximum(off, 1e-9)) / (deviation * spread) ** 2, 0.0)
        for rows, B in basis:
            information = B.T @ (B * weight[rows, None]) + np.eye(B.shape[1]) / (FIELD_SIGMA * middle) ** 2
            field[rows] = B @ np.linalg.solve(information, B.T @ (weight[rows] * difference[rows]))
    if left > UNFIT * USUAL * middle:
        return Depths(inverse, USUAL * middle)
    wrong = known & (np.abs(difference - field) > WRONG * np.hypot(noise, sigma))
    corrected = np.where(wrong, np.nan, inverse - field)
    warp = float(np.sqrt(np.mean(field[known] ** 2))) / middle
    return Depths(np.where(corrected > 0, corrected, np.nan), noise, warp)


def _by_camera(camera: Rows, count: int) -> list[tuple[int, Rows]]:
    return [(k, np.flatnonzero(camera == k)) for k in range(count)]


def _basis(pixels: Array, camera: Camera) -> Array:
    """Return the weight (K, nodes) of each node of the field at pixels (K, 2)."""
    across, down = NODES
    place = np.clip(pixels / (camera.width, camera.height), 0.0, 1.0) * (across - 1, down - 1)
    corner = np.minimum(np.floor(place).astype(np.int64), (across - 2, down - 2))
    part = place - corner
    out = np.zeros((len(pixels), across * down))
    rows = np.arange(len(pixels))
    for right in (0, 1):
        for below in (0, 1):
            share = np.abs(1 - right - part[:, 0]) * np.abs(1 - below - part[:, 1])
            out[rows, (corner[:, 1] + below) * across + corner[:, 0] + right] = share
    return out
