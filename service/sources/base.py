"""What a source is, and the one that most data sets share: a list of image files."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.decode import UnreadableImageError, read_depth, read_image
from seamark.service.stamps import NANOSECONDS
from seamark.service.types import Trajectory

# Frames that are decoded ahead of the one in use.
DECODE_AHEAD = 4

Item = TypeVar("Item")
Result = TypeVar("Result")


class SourceError(SeamarkError):
    """A source is missing, empty, contradicts itself or does not offer what was asked for."""


@dataclass(frozen=True)
class Unreadable:
    """Stands in a source for a frame of which an image is missing, truncated or undecodable."""

    index: int
    stamp_ns: int
    file: str
    reason: str


class Source(Protocol):
    """A sequence of frames.

    ``modes`` are all that the source offers, the richest first, and ``mode`` is the one its frames are made for: the
    one asked for, else the richest. ``ground_truth`` is of cam0 and may be denser than the frames. ``n_frames`` and
    ``stamps_ns`` (N,) int64 are None where only reading to the end would tell. ``period_ns`` is the usual time between
    two frames. ``frames()`` may be called more than once and always begins at the first frame.
    """

    @property
    def name(self) -> str:
        """Return the name for reports."""

    @property
    def mode(self) -> Mode:
        """Return the mode that the frames are made for."""

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Return the modes on offer, the richest first."""

    @property
    def rig(self) -> Rig | None:
        """Return the calibration, None where there is none."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """Return the true path of cam0."""

    @property
    def n_frames(self) -> int | None:
        """Return the number of frames, unreadable ones included."""

    @property
    def stamps_ns(self) -> NDArray[np.int64] | None:
        """Return the stamps of all frames."""

    @property
    def period_ns(self) -> int:
        """Return the usual time from one frame to the next."""

    def frames(self) -> Iterator[Frame | Unreadable]:
        """Yield all frames in order."""


@dataclass(frozen=True)
class Entry:
    """The files of one frame; ``right`` and ``depth`` may be missing from the data set."""

    stamp_ns: int
    image: Path
    right: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True, eq=False)
class FileSource:
    """Frames from image files below ``root``; decoding runs ahead in one thread, the order is that of ``entries``."""

    root: Path
    name: str
    mode: Mode
    modes: tuple[Mode, ...]
    rig: Rig | None
    ground_truth: Trajectory | None
    entries: tuple[Entry, ...]
    period_ns: int

    @property
    def n_frames(self) -> int:
        """Return the number of frames, unreadable ones included."""
        return len(self.entries)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Return the stamps of all frames."""
        return np.array([entry.stamp_ns for entry in self.entries], np.int64)

    def frames(self) -> Iterator[Frame | Unreadable]:
        """Yield all frames in order."""
        return ahead(self._load, enumerate(self.entries))

    def _load(self, numbered: tuple[int, Entry]) -> Frame | Unreadable:
        index, entry = numbered
        file = relative(entry.image, self.root)
        try:
            right = read_image(_present(entry.right, "right image")) if self.mode is Mode.STEREO else None
            depth = read_depth(_present(entry.depth, "depth image")) if self.mode is Mode.RGBD else None
            return Frame(index, entry.stamp_ns, read_image(entry.image), right, depth, file)
        except UnreadableImageError as error:
            return Unreadable(index, entry.stamp_ns, file, str(error))


def file_source(
    root: Path,
    entries: list[Entry],
    rig: Rig | None,
    ground_truth: Trajectory | None,
    modes: tuple[Mode, ...],
    mode: Mode | None,
) -> FileSource:
    """Make a source of files in the mode asked for, or the richest of ``modes``; raises SourceError."""
    if not entries:
        raise SourceError(f"{root} holds no frames")
    stamps = np.array([entry.stamp_ns for entry in entries], np.int64)
    period = int(np.median(np.diff(stamps))) if len(stamps) > 1 else NANOSECONDS
    chosen = choose(mode, modes, str(root))
    return FileSource(
        root,
        root.resolve().name,
        chosen,
        modes,
        rig,
        ground_truth,
        tuple(entries),
        period if period > 0 else NANOSECONDS,
    )


def offered(rig: Rig | None, *, stereo: bool, depth: bool) -> tuple[Mode, ...]:
    """Return the modes that images can run in, the richest first: without calibration they show places only."""
    if rig is None:
        return (Mode.PLACES,)
    modes = [Mode.RGBD] if depth else []
    if stereo and rig.cam1 is not None:
        modes.append(Mode.STEREO)
    return (*modes, Mode.MONO, Mode.PLACES)


def choose(mode: Mode | None, modes: tuple[Mode, ...], name: str) -> Mode:
    """Return the mode asked for or the richest one; raises SourceError when it is not on offer."""
    if mode is None:
        return modes[0]
    if mode not in modes:
        missing = " (no calibration was found; give one with --calib)" if modes == (Mode.PLACES,) else ""
        raise SourceError(f"{name} does not offer mode {mode}; it offers {', '.join(modes)}{missing}")
    return mode


def ahead(load: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield load(item) in order while a thread works on the next ones; OpenCV frees the GIL when it decodes."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="decode")
    pending: deque[Future[Result]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(load, item))
            if len(pending) > DECODE_AHEAD:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def relative(path: Path, root: Path) -> str:
    """Return the path below root with forward slashes."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.as_posix()


def _present(path: Path | None, what: str) -> Path:
    if path is None:
        raise UnreadableImageError(f"there is no {what}")
    return path
