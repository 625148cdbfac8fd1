"""A first guess of the distance of points that nothing is known of yet: that of what is seen beside them."""

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = 5
SPREAD = 0.5  # relative standard deviation of a presumed distance


def presume(
    pixels: NDArray[np.floating], known_pixels: NDArray[np.floating], known_depths: NDArray[np.floating]
) -> NDArray[np.float64] | None:
    """Return the depths (N,) of points at pixels (N, 2), each the median of its neighbours among the known ones.

    ``known_pixels`` (M, 2) and ``known_depths`` (M,); None when M is less than NEIGHBOURS. Inverse depths are averaged,
    because these are what the image moves by.
    """
    if len(known_pixels) < NEIGHBOURS:
        return None
    inverse = 1 / np.maximum(np.asarray(known_depths, np.float64), 1e-3)
    apart = (pixels[:, :1] - known_pixels[:, 0]) ** 2 + (pixels[:, 1:] - known_pixels[:, 1]) ** 2
    beside = np.argpartition(apart, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    depths: NDArray[np.float64] = 1 / np.median(inverse[beside], axis=1)
    return depths
