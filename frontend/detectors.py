"""The choice of corner detector, and Harris-Laplace corners spread over the image like the others."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.corners import BORDER_PX, away_from, cell_side, detect_corners, least_response, refine
from seamark.frontend.harris_laplace import harris_laplace
from seamark.frontend.masks import Mask, allowed

SCALED_RESPONSE = 10.0  # at large scales smooth shading is a corner too


def find_corners(
    grey: NDArray[np.uint8], occupied: NDArray[np.floating], config: FrontendConfig, mask: Mask | None
) -> NDArray[np.float32]:
    """Find new corners (M, 2) float32 of a grey image by the detector of the configuration, away from ``occupied``
    (N, 2) and not where the mask is zero.
    """
    if config.corner_detector == "harris_laplace":
        return _scaled_corners(grey, occupied, config, mask)
    return detect_corners(
        grey,
        occupied,
        config.max_corners,
        harris=config.corner_detector == "harris",
        min_response=config.min_corner_response,
        mask=mask,
    )


def _scaled_corners(
    grey: NDArray[np.uint8], occupied: NDArray[np.floating], config: FrontendConfig, mask: Mask | None
) -> NDArray[np.float32]:
    """Return the strongest Harris-Laplace corner of every grid cell without a point."""
    height, width = grey.shape
    cell = cell_side(grey.shape, config.max_corners)
    if min(height, width) < 2 * cell:
        return np.zeros((0, 2), np.float32)
    found = harris_laplace(grey, min_response=SCALED_RESPONSE * least_response(grey, config.min_corner_response))
    inside = (found.points >= BORDER_PX).all(axis=1) & (found.points < [width - BORDER_PX, height - BORDER_PX]).all(1)
    inside &= allowed(mask, found.points)
    points, strengths = found.points[inside], found.strengths[inside]
    columns = -(-width // cell)

    def cells(of: NDArray[np.floating]) -> NDArray[np.int64]:
        grid = np.floor(of / cell).astype(np.int64)
        return grid[:, 1] * columns + grid[:, 0]

    _, first = np.unique(cells(points), return_index=True)  # of a cell the strongest comes first
    first = first[~np.isin(cells(points)[first], cells(np.asarray(occupied).reshape(-1, 2)))]
    return refine(grey, away_from(points[first], strengths[first], occupied, 0.5 * cell))
