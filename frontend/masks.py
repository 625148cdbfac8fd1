"""Where an image must not be used: the robot's own bonnet, a watermark, what a source says of one frame.

A mask is uint8, zero where nothing may be tracked or remembered. One comes with the configuration and holds for all
frames, one may come with a frame; where both do, both hold.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.frontend.camera import Camera

Mask = NDArray[np.uint8]


class MaskError(SeamarkError):
    """A mask that cannot be read, or is of another size than the images."""


def read_mask(path: Path, camera: Camera | None) -> Mask:
    """Read a mask from an image file, (H, W) uint8; raises MaskError."""
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if mask is None:
        raise MaskError(f"the mask {path} cannot be read as an image")
    if camera is not None and mask.shape != (camera.height, camera.width):
        height, width = mask.shape
        raise MaskError(f"the mask {path} has {width} x {height} pixels, not {camera.width} x {camera.height}")
    return np.ascontiguousarray(mask, np.uint8)


def combined(first: Mask | None, second: Mask | None) -> Mask | None:
    """Return what two masks of one size leave, None where neither forbids anything."""
    if first is None or second is None:
        return second if first is None else first
    return np.where(second > 0, first, np.uint8(0))


def allowed(mask: Mask | None, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which points (N, 2) a mask allows; points outside it count as on its border."""
    if mask is None or len(points) == 0:
        return np.ones(len(points), bool)
    height, width = mask.shape
    column = np.clip(np.rint(points[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(points[:, 1]).astype(int), 0, height - 1)
    return mask[row, column] > 0
