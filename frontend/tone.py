"""The tone of one image laid upon another: what flow needs where exposure, gain or gamma have changed between them.

Lucas-Kanade compares brightness. Two images of nearly the same view have nearly the same distribution of it, so the
curve that maps the quantiles of one onto those of the other (histogram specification, Gonzalez and Woods) undoes any
monotone change: a step of the exposure, flicker, gamma. Where it is next to nothing the image is left alone.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

EVERY_ROW = 4  # of the rows are counted
MIN_CHANGE_GREY = 4.0  # mean change of tone below which brightness counts as constant


def tone_curve(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """Return the curve (256,) uint8 that gives one grey image the tone of another of its size, None if it has it."""
    counts = np.stack([_histogram(before), _histogram(after)])
    shares = np.cumsum(counts, axis=1) / max(1.0, float(counts[0].sum()))
    middle = shares - 0.5 * counts / max(1.0, float(counts[0].sum()))  # a level stands for the middle of its quantiles
    present = counts[1] > 0
    curve = np.interp(middle[0], middle[1][present], np.flatnonzero(present))
    change = float(np.abs(curve - np.arange(256)) @ counts[0]) / max(1.0, float(counts[0].sum()))
    return None if change < MIN_CHANGE_GREY else np.rint(curve).astype(np.uint8)


def match_tone(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """Return one grey image in the tone of another of its size, None where it has it."""
    curve = tone_curve(before, after)
    return None if curve is None else cv2.LUT(before, curve)


def _histogram(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(grey[::EVERY_ROW])
    return cv2.calcHist([rows], [0], None, [256], [0, 256]).ravel().astype(np.float64)
