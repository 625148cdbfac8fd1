"""What every synthetic world hands out: frames with their ground truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
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

    ``mode`` is the richest mode that the frames offer; pose i of ``ground_truth`` belongs to frame i. ``labels()`` is a
    pass over which pixels of the left picture are what; it exists where the name of the sequence has ``labels=1``.
    """

    name: str
    rig: Rig
    mode: Mode
    n_frames: int
    ground_truth: GroundTruth
    make_frames: Callable[[], Iterator[Frame]] = field(repr=False)
    make_labels: Callable[[], Iterator[NDArray[np.uint8]]] | None = field(default=None, repr=False)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames in order of their index."""
        return self.make_frames()

    def labels(self) -> Iterator[NDArray[np.uint8]]:
        """Yield labels (H, W) uint8 in the order of the frames: 0 nothing, 1 static, 2 sky, 10 and more movers.

        After a complete pass over ``frames()`` they are read from the cache, before it they are rendered. Raises
        SeamarkError where the sequence has none.
        """
        if self.make_labels is None:
            raise SeamarkError(f"the sequence {self.name} has no labels; rendered worlds have them with labels=1")
        return self.make_labels()
