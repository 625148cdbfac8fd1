"""Corners with their characteristic scale: Harris-Laplace (Mikolajczyk and Schmid 2004).

Harris corners are found on a ladder of scales; of each, the scale is kept at which the normalised Laplacian has a
maximum. The same corner seen from twice as far has half the scale.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FIRST_SIGMA_PX = 1.6
STEP = 2**0.25  # between the scales of the ladder
N_SCALES = 12
INTEGRATION = 1.4  # derivatives are taken at 1 / 1.4 of the scale that products are summed at
HARRIS_K = 0.06
PEAK_SIGMAS = 1.0  # a corner is the strongest within so many of its scales
DRIFT_SIGMAS = 1.0  # and may move by so many from one scale to the next


@dataclass(frozen=True, eq=False)
class ScaledCorners:
    """Corners, strongest first: ``points`` (N, 2) and ``scales`` (N,) (sigma) in pixels, ``strengths`` (N,) float32."""

    points: NDArray[np.float32]
    scales: NDArray[np.float32]
    strengths: NDArray[np.float32]


def harris_laplace(grey: NDArray[np.uint8], *, min_response: float) -> ScaledCorners:
    """Find the corners of a grey image whose scale-normalised Harris response exceeds ``min_response`` squared."""
    image = grey.astype(np.float32) * np.float32(1 / 255)
    sigmas = FIRST_SIGMA_PX * STEP ** np.arange(N_SCALES)
    laplacians = np.stack([_laplacian(image, sigma) for sigma in sigmas])
    found = []
    for k in range(1, N_SCALES - 1):
        points, strengths = _peaks(_harris(image, sigmas[k]), sigmas[k], min_response**2)
        rows, columns = points[:, 1], points[:, 0]
        below, here, above = (np.abs(laplacians[j][rows, columns]) for j in (k - 1, k, k + 1))
        best = (here > below) & (here >= above)
        # the top of a parabola through the three, in steps of the ladder
        bend = np.maximum(2 * here - below - above, 1e-12)
        offset = np.clip(0.5 * (above - below) / bend, -0.5, 0.5)
        scales = sigmas[k] * STEP**offset
        found.append(np.column_stack([points, scales, strengths])[best])
    table = _distinct(np.vstack(found))
    return ScaledCorners(*(np.ascontiguousarray(part, np.float32) for part in (table[:, :2], table[:, 2], table[:, 3])))


def _smooth(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return cv2.GaussianBlur(image, (0, 0), sigma)


def _laplacian(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Return the Laplacian (H, W) of the image at a scale, normalised by it."""
    return cv2.Laplacian(_smooth(image, sigma), cv2.CV_32F, ksize=1) * np.float32(sigma**2)


def _harris(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Return the Harris response (H, W) at a scale, normalised by it."""
    smooth = _smooth(image, sigma / INTEGRATION)
    gx, gy = (cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    xx, yy, xy = (_smooth(product, sigma) for product in (gx * gx, gy * gy, gx * gy))
    response: NDArray[np.float32] = (xx * yy - xy * xy - HARRIS_K * (xx + yy) ** 2) * np.float32(
        (sigma / INTEGRATION) ** 4
    )
    return response


def _peaks(response: NDArray[np.float32], sigma: float, floor: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the local maxima (N, 2) as (column, row) above the floor, away from the border, and their values (N,)."""
    radius = max(1, round(PEAK_SIGMAS * sigma))
    highest = cv2.dilate(response, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    border = int(np.ceil(2 * sigma))
    inside = np.zeros(response.shape, bool)
    inside[border:-border, border:-border] = True
    rows, columns = np.nonzero((response >= highest) & (response > floor) & inside)
    return np.column_stack([columns, rows]), response[rows, columns]


def _distinct(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keep of corners (N, 4) that are found at neighbouring scales the strongest; strongest first."""
    table = table[np.lexsort((table[:, 1], table[:, 0], -table[:, 3]))]
    kept: list[NDArray[np.float64]] = []
    for row in table:
        others = np.stack(kept) if kept else np.zeros((0, 4))
        near = np.linalg.norm(others[:, :2] - row[:2], axis=1) < DRIFT_SIGMAS * np.minimum(others[:, 2], row[2])
        alike = np.abs(np.log(others[:, 2] / row[2])) < 2 * np.log(STEP)
        if not (near & alike).any():
            kept.append(row)
    return np.stack(kept) if kept else np.zeros((0, 4))
