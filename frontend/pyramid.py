"""Images made ready for patches: the image and its halves, built once and read by all that follows or aligns."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.kernels import native

Pyramid = native.Pyramid


def pyramid_of(grey: NDArray[np.uint8], levels: int) -> Pyramid:
    """Return the pyramid of a grey image (H, W) uint8, reduced ``levels`` times or as often as 16 rows and columns are
    left (Burt and Adelson 1983). It keeps a copy.
    """
    return native.Pyramid(np.ascontiguousarray(grey), levels)
