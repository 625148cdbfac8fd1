"""How sure a map is of its newest poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapError
from seamark.backend.map_open import loader, restore
from seamark.backend.map_store import MapStore
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.slam import Slam
from seamark.frontend.types import Mode


@dataclass(frozen=True, eq=False)
class PoseCovariances:
    """Marginal covariances (K, 6, 6) of poses by ascending ``keyframe_ids`` (K,), and their ``components`` (K,).

    Each is in its keyframe's frame and units, rotation (rad) first, relative to the first keyframe of its component.
    """

    keyframe_ids: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    components: NDArray[np.int64]
    covariances: NDArray[np.float64]

    def sigmas(self) -> NDArray[np.float64]:
        """Return the root mean square deviations (K, 2) along an axis: of rotation in degrees, of translation."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
        return np.asarray(np.sqrt(variances) * (np.rad2deg(1.0), 1.0))


def pose_covariances(path: Path, last: int, config: BackendConfig) -> PoseCovariances:
    """Return the covariances of the ``last`` newest poses of a map, which a service may be writing.

    The map's pose graph is solved for it, in this process; nothing is written. Raises MapError for a map without poses
    or one that cannot be read, SolverError where the graph has no solution.
    """
    with MapStore(path, read_only=True) as store:
        mode = Mode(store.meta().get("mode", Mode.RGBD))
        if mode is Mode.PLACES:
            raise MapError(f"{path} has no poses: it is of mode places")
        graph = PoseGraph(config)
        slam = Slam(config, mode, graph, 0, loader(store))
        before, _ = restore(slam, store)
        if not before:
            raise MapError(f"{path} has no poses")
        estimate = graph.optimise()
        newest = estimate.keyframe_ids[-last:]
        stamps = {keyframe.id: keyframe.stamp_ns for keyframe in before}
    return PoseCovariances(
        newest,
        np.array([stamps[number] for number in newest.tolist()], np.int64),
        estimate.components[-last:],
        graph.covariances(newest.tolist()),
    )
