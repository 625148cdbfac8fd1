"""Pyramidal Lucas-Kanade with a guess, a forward-backward check and a look at the patch that was found.

Bouguet 2001, Baker and Matthews 2004, Kalal et al. 2010. Patches are compared only where both lie inside their images.
Their means are taken off only where the images differ in brightness: as long as the light stays, they tell something.
The loops are in native/flow.cpp, in whole numbers: every processor gives the same bits.
"""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.kernels import native
from seamark.frontend.pyramid import Pyramid

BACK_LEVELS = 1  # the way back begins close to where it should end
BRIGHTNESS_GREY = 8.0  # images whose means are farther apart differ in exposure, and patches lose their means


def track(
    before: Pyramid,
    after: Pyramid,
    points: NDArray[np.float32],
    guess: NDArray[np.float32] | None,
    *,
    window_px: int,
    levels: int,
    round_trip_px: float,
    min_correlation: float,
    reach_px: float = np.inf,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Follow points (N, 2) from one image to another, starting at ``guess`` (N, 2) if given.

    Returns the points (N, 2) float32 in ``after`` and which of them survive: found, moved on no level of the pyramid by
    more than ``reach_px``, inside the image, back within ``round_trip_px`` of where they came from when tracked
    backward, and with a patch whose zero-mean normalised correlation with the one it came from is at least
    ``min_correlation``.
    """
    start = np.ascontiguousarray(points, np.float32)
    first = start if guess is None else np.ascontiguousarray(guess, np.float32)
    side, back = window_px // 2 * 2 + 1, min(BACK_LEVELS, levels)
    changed = abs(_brightness(after) - _brightness(before)) > BRIGHTNESS_GREY
    there, round_trip, correlation = native.follow(
        before,
        after,
        start,
        first,
        side,
        levels,
        back,
        level_out=changed,
        least_likeness=min_correlation,
        reach=reach_px,
    )
    height, width = after.grey.shape
    inside = (there >= 0).all(axis=1) & (there <= [width - 1, height - 1]).all(axis=1)
    return there, inside & (round_trip < round_trip_px) & (correlation >= min_correlation)


def _brightness(image: Pyramid) -> float:
    return float(image.level(image.top).mean())
