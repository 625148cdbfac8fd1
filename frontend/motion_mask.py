"""What moves while the camera stands still: the difference from the median of what was seen before.

A camera that stands needs no geometry to tell what moves. The background is the median over time of small copies of
the image (temporal median filtering, as in Cucchiara et al. 2003); what differs from it by more than noise moves. While
the camera moves nothing is computed but how far.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3

SQUARE_PX = 4  # one element of the mask is for a square of so many pixels
MOVED_PX = 1.5  # a camera that has moved its picture farther does not stand any more
SAMPLE_S = 0.3
MAX_SAMPLES = 9
MIN_SAMPLES = 3
MIN_DIFFERENCE_GREY = 8.0
NOISE_SIGMAS = 6.0
OPEN, CLOSE = (np.ones((side, side), np.uint8) for side in (3, 5))


class MotionMasks:
    """Makes the masks of one session's camera; ``focal_px`` turns its motion into pixels."""

    def __init__(self, focal_px: float) -> None:
        self._focal_px = focal_px
        self._T_odom_stand: NDArray[np.float64] | None = None
        self._samples: list[NDArray[np.uint8]] = []
        self._sampled_ns = 0
        self._background: NDArray[np.float32] | None = None

    def step(
        self, grey: NDArray[np.uint8], stamp_ns: int, T_odom_cam: NDArray[np.float64], depth: float
    ) -> NDArray[np.uint8] | None:
        """Return the mask (h, w) uint8, 255 where something moves, or None where the camera has not stood for long.

        ``depth`` is the distance of the scene in units of the pose.
        """
        if self._T_odom_stand is None or self._moved_px(T_odom_cam, depth) > MOVED_PX:
            self._T_odom_stand, self._samples, self._background = T_odom_cam, [], None
            self._sampled_ns = stamp_ns
            return None
        small = _small(grey)
        if not self._samples or stamp_ns - self._sampled_ns >= 1e9 * SAMPLE_S:
            self._samples = [*self._samples, small][-MAX_SAMPLES:]
            self._sampled_ns = stamp_ns
            if len(self._samples) >= MIN_SAMPLES:
                self._background = np.median(np.stack(self._samples), axis=0).astype(np.float32)
        return None if self._background is None else _moving(small, self._background)

    def _moved_px(self, T_odom_cam: NDArray[np.float64], depth: float) -> float:
        """Return by how much the picture has moved since the camera came to stand."""
        assert self._T_odom_stand is not None
        T = se3.inverse(self._T_odom_stand) @ T_odom_cam
        return self._focal_px * (float(se3.rotation_angle(T[:3, :3])) + float(np.linalg.norm(T[:3, 3])) / depth)


def _small(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = grey.shape
    size = (-(-width // SQUARE_PX), -(-height // SQUARE_PX))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _moving(small: NDArray[np.uint8], background: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return where an image differs from its background by more than noise and a change of exposure explain."""
    difference = small - background
    difference -= np.median(difference)
    size = np.abs(difference)
    threshold = max(MIN_DIFFERENCE_GREY, NOISE_SIGMAS * 1.4826 * float(np.median(size)))
    mask = np.where(size > threshold, np.uint8(255), np.uint8(0))
    return cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, OPEN), cv2.MORPH_CLOSE, CLOSE)
