"""What every synthetic world hands out: frames with their ground truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Exact poses of cam0: ``stamps_ns`` (N,) int64 ascending and ``T_world_cam`` (N, 4, 4) float64, world z up."""

    stamps_ns: NDArray[np.int64]
    T_world_cam: NDArray[np.float64]

    def __post_init__(self) -> None:
        self.stamps_ns.setflags(write=False)
        self.T_world_cam.setflags(write=False)

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)


@dataclass(frozen=True, eq=False)
class SynthSequence:
    """A rendered run: ``frames()`` starts a new pass over the ``n_frames`` frames, in order, each time it is called.

    ``mode`` is the richest mode that the frames offer; pose i of ``ground_truth`` belongs to frame i.
    """

    name: str
    rig: Rig
    mode: Mode
    n_frames: int
    ground_truth: GroundTruth
    make_frames: Callable[[], Iterator[Frame]] = field(repr=False)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames in order of their index."""
        return self.make_frames()
