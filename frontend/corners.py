"""Corners spread over the image: Harris (1988) or Shi-Tomasi (1994) response, the best of every free grid cell,
sub-pixel refined. The loops over pixels are in native/corners.cpp.

Two floors hold noise off: a share of the image's own strong corners, and a least response. In images of low contrast,
where the second would leave nothing, it sinks to what their noise can reach.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.kernels import native

HARRIS_K = 0.04
BORDER_PX = 8
RELATIVE_RESPONSE = 0.002  # of the image's strongest corners: keeps dark and low-texture images populated
NOISE_RESPONSE = 3.0  # noise alone reaches 2.1 times its variance in an image
LEAST_RESPONSE = 6e-6  # the contours that rounding to whole grey levels makes of smooth shading reach 5e-6
SUBPIXEL = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 0.02)


def least_response(grey: NDArray[np.uint8], min_response: float) -> float:
    """Return what a Shi-Tomasi response must exceed: ``min_response``, or less where the noise of the image is low.

    The noise is estimated after Immerkaer (1996), by the median, which texture hardly moves.
    """
    sigma = native.median_difference(grey) / (6 * 0.6745 * 255)
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
    mask = None if mask is None else np.ascontiguousarray(mask)
    best, strength = native.strongest(grey, cell, BORDER_PX, HARRIS_K if harris else 0.0, mask)
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
    points = best[chosen].astype(np.float32)
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
    points = np.ascontiguousarray(points[np.argsort(-strength, kind="stable")], np.float32)
    others = np.ascontiguousarray(occupied, np.float32).reshape(-1, 2)
    return points[native.apart(points, others, distance, to_each_other=True)]
