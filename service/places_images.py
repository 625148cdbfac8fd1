"""Images described for place recognition, however large they are and whatever is wrong with them."""

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features, thumbnail_of
from seamark.frontend.types import Frame
from seamark.service.sources.base import Unreadable
from seamark.service.sources.decode import UnreadableImageError, read_image
from seamark.vocab.spatial import LocalFeatures
from seamark.vocab.types import PlaceObservation

# SIFT finds little on small pictures (vpr_corridor, 160 x 120: recall@1 of the votes .25, enlarged to 480 .43), and its
# time grows with the area.
SMALLEST_PX, LARGEST_PX = 480, 1280
MOST_ENLARGED = 4.0
COMPARED_FEATURES = 500  # the strongest; twice as many cost four times the time and rank no better
AHEAD_PER_WORKER = 2

Progress = Callable[[int, int], None]
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class DescribedImage:
    """What is compared of one image; ``problem`` says in one sentence why nothing is, for an unreadable one.

    ``scales`` (N,) and ``angles`` (N,) float32 are those of all descriptors, pixels and radians.
    """

    name: str
    descriptors: NDArray[np.uint8]
    features: LocalFeatures
    thumbnail: NDArray[np.uint8]
    problem: str | None = None
    scales: NDArray[np.float32] | None = None
    angles: NDArray[np.float32] | None = None

    def observation(self, place_id: int, session: int, stamp_ns: int = 0) -> PlaceObservation:
        """Return the image as the place index takes it."""
        points = np.zeros((len(self.descriptors), 2), np.float32)
        return PlaceObservation(
            place_id, session, stamp_ns, self.descriptors, points, self.thumbnail, self.scales, self.angles
        )


def describe_image(image: NDArray[np.uint8], name: str, config: FrontendConfig) -> DescribedImage:
    """Describe a grey or BGR image; its longer side is brought to 480 to 1280 pixels for local features."""
    longer = max(image.shape[:2])
    factor = min(MOST_ENLARGED, max(1.0, SMALLEST_PX / longer)) * min(1.0, LARGEST_PX / longer)
    sized = image
    if factor != 1.0:
        way = cv2.INTER_CUBIC if factor > 1.0 else cv2.INTER_AREA
        size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
        sized = np.asarray(cv2.resize(image, size, interpolation=way), np.uint8)
    found = extract_features(sized, config.sift_features, config.sift_contrast, max_pixels=config.sift_pixels)
    part = slice(COMPARED_FEATURES)
    features = LocalFeatures(
        found.points[part],
        found.scales[part],
        found.angles[part],
        found.descriptors[part],
        sized.shape[1],
        sized.shape[0],
    )
    thumbnail = thumbnail_of(image, config.thumbnail_px)
    return DescribedImage(name, found.descriptors, features, thumbnail, None, found.scales, found.angles)


def describe_files(
    files: list[Path], config: FrontendConfig, workers: int, progress: Progress | None = None
) -> list[DescribedImage]:
    """Describe image files in their order with so many threads; the result does not depend on their number."""

    def load(path: Path) -> DescribedImage:
        try:
            return describe_image(read_image(path), path.name, config)
        except UnreadableImageError as error:
            return _nothing(path.name, str(error))

    return _in_threads(load, files, len(files), workers, progress)


def describe_frames(
    frames: Iterable[Frame | Unreadable],
    count: int | None,
    config: FrontendConfig,
    workers: int,
    progress: Progress | None = None,
) -> list[DescribedImage]:
    """Describe the frames of a source in their order with so many threads."""

    def describe(frame: Frame | Unreadable) -> DescribedImage:
        if isinstance(frame, Unreadable):
            return _nothing(frame.file, frame.reason)
        return describe_image(frame.image, frame.file or str(frame.index), config)

    return _in_threads(describe, frames, count or 0, workers, progress)


def available_workers() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0))


def _nothing(name: str, problem: str) -> DescribedImage:
    none = np.zeros(0, np.float32)
    features = LocalFeatures(np.zeros((0, 2), np.float32), none, none, np.zeros((0, 128), np.uint8), 1, 1)
    return DescribedImage(name, features.descriptors, features, np.zeros((1, 1), np.uint8), problem, none, none)


def _in_threads(
    describe: Callable[[Item], DescribedImage],
    items: Iterable[Item],
    count: int,
    workers: int,
    progress: Progress | None,
) -> list[DescribedImage]:
    """OpenCV frees the interpreter while it looks for features; only a few images are in memory at a time."""
    cv2.setNumThreads(1)
    described: list[DescribedImage] = []

    def keep(future: "Future[DescribedImage]") -> None:
        described.append(future.result())
        if progress is not None:
            progress(len(described), max(count, len(described)))

    with ThreadPoolExecutor(workers, thread_name_prefix="describe") as pool:
        pending: deque[Future[DescribedImage]] = deque()
        for item in items:
            pending.append(pool.submit(describe, item))
            if len(pending) > AHEAD_PER_WORKER * workers:
                keep(pending.popleft())
        while pending:
            keep(pending.popleft())
    return described
