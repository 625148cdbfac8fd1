"""Rendered worlds: ``synth:NAME[,key=value...]``."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.base import SourceError, Unreadable, ahead, choose
from seamark.service.stamps import NANOSECONDS
from seamark.service.types import Trajectory

PREFIX = "synth:"


@dataclass(frozen=True, eq=False)
class SynthSource:
    """A world of datasets_synth as a source; depth is left out of the frames in the modes that must not see it."""

    sequence: Any
    mode: Mode
    modes: tuple[Mode, ...]
    ground_truth: Trajectory

    @property
    def name(self) -> str:
        """Return the name of the world."""
        return str(self.sequence.name)

    @property
    def rig(self) -> Rig:
        """Return the rig of the world's camera."""
        rig: Rig = self.sequence.rig
        return rig

    @property
    def n_frames(self) -> int:
        """Return the number of frames."""
        return int(self.sequence.n_frames)

    @property
    def stamps_ns(self) -> NDArray[np.int64] | None:
        """Return the stamps of all frames, which are those of the ground truth."""
        return self.ground_truth.stamps_ns if len(self.ground_truth) == self.n_frames else None

    @property
    def period_ns(self) -> int:
        """Return the usual time from one frame to the next."""
        stamps = self.ground_truth.stamps_ns
        return int(np.median(np.diff(stamps))) if len(stamps) > 1 else NANOSECONDS

    def frames(self) -> Iterator[Frame | Unreadable]:
        """Yield all frames in order, made ahead in one thread; closing the iterator ends a rendering."""
        made = self.sequence.frames()
        try:
            # One more than there are: only when asked beyond its end does a rendering put itself into the cache.
            for frame in ahead(lambda _: next(made, None), range(self.n_frames + 1)):
                if frame is None:
                    return
                yield self._seen(frame)
        finally:
            made.close()

    def _seen(self, frame: Frame) -> Frame:
        depth = frame.depth if self.mode is Mode.RGBD else None
        right = frame.image_right if self.mode is Mode.STEREO else None
        return Frame(frame.index, frame.stamp_ns, frame.image, right, depth, frame.file)


def open_synth_source(spec: str, *, mode: Mode | None) -> SynthSource:
    """Open ``synth:NAME[,key=value...]``; raises SourceError for an unknown one, SeamarkError where nothing renders."""
    name = spec.removeprefix(PREFIX)
    if not name:
        raise SourceError(f"{spec!r} names no world; write synth:NAME")
    # Imported here, because nothing else of the service needs a simulator.
    from seamark.datasets_synth.scenario import open_synth

    sequence = open_synth(name)
    truth = Trajectory(
        np.asarray(sequence.ground_truth.stamps_ns, np.int64), np.asarray(sequence.ground_truth.T_world_cam, np.float64)
    )
    own = Mode(sequence.mode)
    modes = (own, Mode.MONO, Mode.PLACES) if own in (Mode.RGBD, Mode.STEREO) else (own, Mode.PLACES)
    return SynthSource(sequence, choose(mode, modes, spec), modes, truth)
