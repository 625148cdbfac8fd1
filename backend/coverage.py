"""How much of an image the matches cover."""

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera

CELLS = (8, 6)


def coverage(points: NDArray[np.float32], chosen: NDArray[np.float32], camera: Camera | None) -> tuple[int, float]:
    """Return how many cells of an 8 x 6 grid over the image the ``chosen`` points (K, 2) occupy, and the area of their
    hull per area of the image; without a camera the image is taken to reach as far as all ``points`` (N, 2).
    """
    size, origin = np.ptp(points, axis=0).astype(np.float64) + 1.0, points.min(axis=0).astype(np.float64)
    if camera is not None:
        size, origin = np.array([camera.width, camera.height], np.float64), np.zeros(2)
    cells = np.clip((chosen - origin) / size * CELLS, 0, np.array(CELLS) - 1).astype(np.int64)
    hull = cv2.convexHull(np.ascontiguousarray(chosen, np.float32))
    return len(np.unique(cells, axis=0)), float(cv2.contourArea(hull) / (size[0] * size[1]))
