"""Video files, read by OpenCV."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.base import SourceError, Unreadable, ahead, choose, offered
from seamark.service.sources.decode import to_image
from seamark.service.stamps import running_stamp

SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ogv"})
FALLBACK_FPS = 30.0


@dataclass(frozen=True, eq=False)
class VideoSource:
    """Frames of a video file; the stamps are running index / fps.

    The container's own count of frames is a guess, so ``n_frames`` and ``stamps_ns`` are unknown.
    """

    path: Path
    name: str
    mode: Mode
    modes: tuple[Mode, ...]
    rig: Rig | None
    fps: float
    ground_truth: None = None
    n_frames: None = None
    stamps_ns: None = None

    @property
    def period_ns(self) -> int:
        """Return the time from one frame to the next."""
        return running_stamp(1, self.fps)

    def frames(self) -> Iterator[Frame | Unreadable]:
        """Yield all frames in order; the file name of a frame is ``video.mp4#index``."""
        capture = cv2.VideoCapture(str(self.path))
        try:
            yield from self._read(capture)
        finally:
            capture.release()

    def _read(self, capture: cv2.VideoCapture) -> Iterator[Frame]:
        # Reading goes on in one thread and in order, so `ahead` may ask for frames beyond the end: it gets None.
        def load(index: int) -> NDArray[np.uint8] | None:
            good, image = capture.read()
            return to_image(image, f"{self.path.name}#{index}") if good else None

        for index, image in enumerate(ahead(load, count())):
            if image is None:
                return
            yield Frame(index, running_stamp(index, self.fps), image, file=f"{self.path.name}#{index:06d}")


def open_video(path: Path, *, rig: Rig | None, mode: Mode | None, fps: float | None) -> VideoSource:
    """Open a video file, whose own frame rate holds unless one is given; raises SourceError."""
    capture = cv2.VideoCapture(str(path))
    try:
        good = capture.isOpened() and capture.read()[0]
        own = float(capture.get(cv2.CAP_PROP_FPS))
    finally:
        capture.release()
    if not good:
        raise SourceError(f"{path} cannot be read as a video")
    rate = fps or (own if np.isfinite(own) and own > 0 else FALLBACK_FPS)
    modes = offered(rig, stereo=False, depth=False)
    return VideoSource(path, path.name, choose(mode, modes, str(path)), modes, rig, rate)
