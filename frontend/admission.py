"""Which frames can be used at all: every picture that a mode reads must be what Frame says it is."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.types import Frame, Mode, Outcome, Rig


def refusal(frame: Frame, rig: Rig | None, mode: Mode) -> Outcome | None:
    """Return why the pictures of a frame cannot be used, or None; pictures that the mode does not read do not matter.

    UNREADABLE: a picture of another type or number of channels than Frame allows, or without pixels. WRONG_SIZE: an
    image contradicts the calibration (which mode places can do without), or depth has another size than its image.
    """
    right = frame.image_right if mode is Mode.STEREO else None
    depth = frame.depth if mode is Mode.RGBD else None
    if not _is_image(frame.image) or not (right is None or _is_image(right)) or not (depth is None or _is_depth(depth)):
        return Outcome.UNREADABLE
    if rig is not None and mode is not Mode.PLACES and frame.image.shape[:2] != (rig.cam0.height, rig.cam0.width):
        return Outcome.WRONG_SIZE
    if any(other is not None and other.shape[:2] != frame.image.shape[:2] for other in (right, depth)):
        return Outcome.WRONG_SIZE
    return None


def _is_image(image: NDArray[np.generic]) -> bool:
    channels_fit = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    return channels_fit and image.dtype == np.uint8 and image.size > 0


def _is_depth(depth: NDArray[np.generic]) -> bool:
    return depth.ndim == 2 and depth.dtype in (np.uint16, np.float32)
