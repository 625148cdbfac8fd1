"""What one run leaves behind, as values; files are made from them in :mod:`seamark.service.results`."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark.backend.types import MapSnapshot
from seamark.frontend.types import Mode, Odometry


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time: ``stamps_ns`` (N,) int64 ascending and ``T_world_cam`` (N, 4, 4)."""

    stamps_ns: NDArray[np.int64]
    T_world_cam: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_ns)


@dataclass(frozen=True)
class ProcessUsage:
    """What one process of the run has used; ``name`` is the node's."""

    name: str
    peak_rss_bytes: int
    cpu_s: float


@dataclass(frozen=True, eq=False)
class KeyframeSummary:
    """What the runner remembers of a keyframe."""

    id: int
    session: int
    index: int
    stamp_ns: int
    file: str


@dataclass(frozen=True, eq=False)
class RunRecord:
    """Everything that a run found out.

    ``odometry`` has one entry per input frame, in input order, also for frames that could not be read. ``snapshot`` is
    the map after the last optimisation. ``ground_truth`` is of cam0, or None. ``stages_ms`` maps a stage of the work to
    all its latencies in ms (frontend stages, verification, optimisation...). ``wall_s`` is from the first frame sent to
    all nodes drained. ``deterministic`` says that two such runs must give equal files: wall times are left out of them.
    ``known`` are keyframes of a map that the run has localised itself in and left as it was.
    """

    sources: tuple[str, ...]
    mode: Mode
    odometry: tuple[Odometry, ...]
    keyframes: tuple[KeyframeSummary, ...]
    snapshot: MapSnapshot
    ground_truth: Trajectory | None
    processes: tuple[ProcessUsage, ...]
    wall_s: float
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    deterministic: bool = False
    known: tuple[KeyframeSummary, ...] = ()
