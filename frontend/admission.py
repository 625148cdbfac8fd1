"""Which frames can be used at all: pictures must be what Frame says they are, stamps must go on."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.types import Frame, Mode, Outcome, Rig


def refusal(frame: Frame, rig: Rig | None, mode: Mode) -> Outcome | None:
    """Return why the pictures of a frame cannot be used, or None; pictures that the mode does not read do not matter.

    UNREADABLE: a picture of another type or number of channels than Frame allows, or without pixels. WRONG_SIZE: an
    image contradicts the calibration (which mode places can do without), or depth or
    mask has another size than its image.
    """
    right = frame.image_right if mode is Mode.STEREO else None
    depth = frame.depth if mode is Mode.RGBD else None
    if not _is_image(frame.image) or not (right is None or _is_image(right)) or not (depth is None or _is_depth(depth)):
        return Outcome.UNREADABLE
    if rig is not None and mode is not Mode.PLACES and frame.image.shape[:2] != (rig.cam0.height, rig.cam0.width):
        return Outcome.WRONG_SIZE
    if frame.mask is not None and (frame.mask.ndim != 2 or frame.mask.dtype != np.uint8):
        return Outcome.UNREADABLE
    if any(other is not None and other.shape[:2] != frame.image.shape[:2] for other in (right, depth, frame.mask)):
        return Outcome.WRONG_SIZE
    return None


def _is_image(image: NDArray[np.generic]) -> bool:
    channels_fit = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    return channels_fit and image.dtype == np.uint8 and image.size > 0


def _is_depth(depth: NDArray[np.generic]) -> bool:
    return depth.ndim == 2 and depth.dtype in (np.uint16, np.float32)


class StampGate:
    """Decides by their stamps which frames go on in time, and when the sensor's clock is another one.

    One wrong stamp must neither be believed nor stop the frames after it. So a frame before the newest stamp, or far
    after it, is refused, but the next frames may confirm it: a clock that was set back is believed after
    ``clock_back_frames`` in ascending order, a jump forward at the next frame. In mode places, where stamps tell no
    motion, any jump forward goes.
    """

    def __init__(self, mode: Mode, config: FrontendConfig) -> None:
        self._forward_ns = None if mode is Mode.PLACES else round(1e9 * config.clock_jump_s)
        self._needed = config.clock_back_frames
        self._newest_ns: int | None = None
        self._refused_ns: int | None = None  # the last of the stamps that may be a new clock's
        self._run = 0

    def admit(self, stamp_ns: int) -> Outcome | None:
        """Take the next stamp: return why its frame cannot be used, or None, or CLOCK_RESET where time begins anew."""
        newest = self._newest_ns
        if newest is None:
            self._accept(stamp_ns)
            return None
        if stamp_ns == newest:
            return Outcome.REPEATED_STAMP
        backward = stamp_ns < newest
        if not backward and (self._forward_ns is None or stamp_ns - newest <= self._forward_ns):
            self._accept(stamp_ns)
            return None

        refused = self._refused_ns
        follows = refused is not None and refused < stamp_ns and (refused < newest) == backward
        self._run = self._run + 1 if follows else 1
        self._refused_ns = stamp_ns
        if self._run < (self._needed if backward else 2):
            return Outcome.STAMP_BACKWARD if backward else Outcome.STAMP_FORWARD
        self._accept(stamp_ns)
        return Outcome.CLOCK_RESET if backward else None

    def _accept(self, stamp_ns: int) -> None:
        self._newest_ns, self._refused_ns, self._run = stamp_ns, None, 0
