"""Why nothing was found in an image: told from the image itself, once tracking and descriptors have failed."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.corners import detect_corners
from seamark.frontend.types import Loss

EVERY_PX = 4  # pixels are looked at on this grid
DARK_GREY = 16
BRIGHT_GREY = 250
DARK_SHARE = 0.98
BRIGHT_SHARE = 0.5
MIN_CORNERS = 40  # a session needs something to see


def loss_of(grey: NDArray[np.uint8], min_response: float) -> Loss:
    """Return the first that holds of a grey image: DARK, BRIGHT, FEATURELESS, or else UNMATCHED.

    ``min_response`` is the floor of the Shi-Tomasi response of a corner.
    """
    sample = grey[::EVERY_PX, ::EVERY_PX]
    if (sample < DARK_GREY).mean() >= DARK_SHARE:
        return Loss.DARK
    if (sample >= BRIGHT_GREY).mean() >= BRIGHT_SHARE:
        return Loss.BRIGHT
    corners = detect_corners(grey, np.zeros((0, 2)), 4 * MIN_CORNERS, harris=False, min_response=min_response)
    return Loss.FEATURELESS if len(corners) < MIN_CORNERS else Loss.UNMATCHED
