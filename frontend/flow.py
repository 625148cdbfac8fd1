"""Pyramidal Lucas-Kanade tracking with a guess and a forward-backward check (Bouguet 2001; Kalal et al. 2010)."""

import cv2
import numpy as np
from numpy.typing import NDArray

CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.003)
MIN_EIGENVALUE = 1e-4


def track(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: NDArray[np.float32],
    guess: NDArray[np.float32] | None,
    *,
    window_px: int,
    levels: int,
    round_trip_px: float,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Follow points (N, 2) from one grey image to another, starting at ``guess`` (N, 2) if given.

    Returns the points (N, 2) float32 in ``after`` and which of them survive: found, inside the image, and back within
    ``round_trip_px`` of where they came from when tracked backward.
    """
    if len(points) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, bool)
    height, width = after.shape
    start = np.ascontiguousarray(points, np.float32)
    first = start if guess is None else np.ascontiguousarray(guess, np.float32)
    there, found = _flow(before, after, start, first, window_px, levels)
    back, found_back = _flow(after, before, there, start, window_px, min(1, levels))
    inside = (there[:, 0] >= 0) & (there[:, 1] >= 0) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    closed = np.linalg.norm(back - start, axis=1) < round_trip_px
    return there, found & found_back & inside & closed


def _flow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: NDArray[np.float32],
    guess: NDArray[np.float32],
    window_px: int,
    levels: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        guess.copy(),  # OpenCV writes the result here
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=MIN_EIGENVALUE,
    )
    return there, found.reshape(-1).astype(bool)
