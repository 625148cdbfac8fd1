"""Corners spread over the image: Harris or Shi-Tomasi response, the best of every free grid cell, sub-pixel refined.

Two floors hold noise off: a share of the image's own strong corners, and a least response. In images of low contrast,
where the second would leave nothing, it sinks to what their noise can reach.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

HARRIS_K = 0.04
BLOCK_PX = 5
BORDER_PX = 8
RELATIVE_RESPONSE = 0.002  # of the image's strongest corners: keeps dark and low-texture images populated
NOISE_RESPONSE = 3.0  # noise alone reaches 2.1 times its variance in an image
LEAST_RESPONSE = 6e-6  # the contours that rounding to whole grey levels makes of smooth shading reach 5e-6
_NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # blind to edges and ramps
SUBPIXEL = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 0.02)


def corner_response(grey: NDArray[np.uint8], *, harris: bool) -> NDArray[np.float32]:
    """Return the corner response (H, W) float32 of a grey image taken as 0..1.

    Harris and Stephens (1988) or the smaller eigenvalue of Shi and Tomasi (1994).
    """
    image = grey.astype(np.float32) * np.float32(1 / 255)
    if harris:
        return cv2.cornerHarris(image, BLOCK_PX, 3, HARRIS_K)
    return cv2.cornerMinEigenVal(image, BLOCK_PX, ksize=3)


def least_response(grey: NDArray[np.uint8], min_response: float) -> float:
    """Return what a Shi-Tomasi response must exceed: ``min_response``, or less where the noise of the image is low.

    The noise is estimated after Immerkaer (1996), by the median, which texture hardly moves.
    """
    filtered = cv2.filter2D(grey, cv2.CV_32F, _NOISE_FILTER)[::3, ::3]
    sigma = float(np.median(np.abs(filtered))) / (6 * 0.6745 * 255)
    return min(min_response, max(LEAST_RESPONSE, NOISE_RESPONSE * sigma**2))


def detect_corners(
    grey: NDArray[np.uint8],
    occupied: NDArray[np.floating],
    n_corners: int,
    *,
    harris: bool,
    min_response: float,
    mask: NDArray[np.uint8] | None = None,
) -> NDArray[np.float32]:
    """Find new corners (M, 2) float32 in the grid cells that no point of ``occupied`` (N, 2) lies in.

    The grid has about ``n_corners`` cells; M + N stays near ``n_corners`` at most. A cell's corner must exceed
    ``min_response`` (for Harris its square, the response being a product of two eigenvalues), or less in an image of
    low contrast, and a small share of the image's strong corners. None is taken where ``mask`` (H, W) is zero.
    """
    height, width = grey.shape
    cell = cell_side(grey.shape, n_corners)
    rows, columns = height // cell, width // cell
    if rows == 0 or columns == 0:
        return np.zeros((0, 2), np.float32)
    response = corner_response(grey, harris=harris)
    response[:BORDER_PX] = response[-BORDER_PX:] = 0
    response[:, :BORDER_PX] = response[:, -BORDER_PX:] = 0
    if mask is not None:
        response[mask == 0] = 0

    cells = response[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell).swapaxes(1, 2)
    flat = cells.reshape(rows * columns, cell * cell)
    best = flat.argmax(axis=1)
    strength = flat[np.arange(len(flat)), best]
    relative = RELATIVE_RESPONSE * float(np.quantile(strength, 0.95))
    if relative < (min_response**2 if harris else min_response):
        least = least_response(grey, min_response)
        relative = max(relative, least**2 if harris else least)
    wanted = strength > relative

    if len(occupied):
        grid = np.floor(np.asarray(occupied) / cell).astype(int)
        inside = (grid[:, 0] >= 0) & (grid[:, 0] < columns) & (grid[:, 1] >= 0) & (grid[:, 1] < rows)
        wanted[grid[inside, 1] * columns + grid[inside, 0]] = False
    chosen = np.flatnonzero(wanted)
    if len(chosen) == 0:
        return np.zeros((0, 2), np.float32)
    y = chosen // columns * cell + best[chosen] // cell
    x = chosen % columns * cell + best[chosen] % cell
    points = np.column_stack([x, y]).astype(np.float32)
    return refine(grey, away_from(points, strength[chosen], occupied, 0.5 * cell))


def cell_side(shape: tuple[int, ...], n_corners: int) -> int:
    """Return the side in pixels of the grid's cells, of which an image (H, W) has about ``n_corners``."""
    return max(8, round(float(np.sqrt(shape[0] * shape[1] / n_corners))))


def refine(grey: NDArray[np.uint8], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Move corners (N, 2) to where the gradients around them say, without those that run away."""
    if len(points) == 0:
        return np.zeros((0, 2), np.float32)
    refined = cv2.cornerSubPix(grey, points.reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), SUBPIXEL).reshape(-1, 2)
    settled = np.linalg.norm(refined - points, axis=1) < 4
    return np.ascontiguousarray(refined[settled], np.float32)


def away_from(
    points: NDArray[np.float32],
    strength: NDArray[np.float32],
    occupied: NDArray[np.floating],
    distance: float,
) -> NDArray[np.float32]:
    """Keep the strongest points that are at least ``distance`` from each other and from ``occupied``."""
    order = np.argsort(-strength, kind="stable")
    points = points[order]
    everything = np.vstack([np.asarray(occupied, np.float32).reshape(-1, 2), points])
    gap = np.linalg.norm(points[:, None] - everything[None], axis=2)
    first = len(everything) - len(points)
    rank = np.arange(len(points))
    gap[rank[:, None] + first <= np.arange(len(everything))[None]] = np.inf  # itself and weaker ones do not count
    return points[(gap >= distance).all(axis=1)]
