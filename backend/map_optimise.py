"""Optimising a map that no service has open: its pose graph, or everything that its keyframes have seen."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark.backend.bundle_adjustment import Adjusted, adjust
from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapError
from seamark.backend.map_store import FEATURES, MapStore
from seamark.backend.types import MapSnapshot
from seamark.frontend import se3

Matrix = NDArray[np.float64]
LEAST_KEYFRAMES = 3  # of a component that is worth adjusting


@dataclass(frozen=True, eq=False)
class Optimised:
    """What a full optimisation did: each component's adjustment, poses before and after, and the revision written.

    ``revision`` is None where nothing was written, because no component got better.
    """

    components: Mapping[int, Adjusted]
    keyframe_ids: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    component_of: NDArray[np.int64]
    before: Matrix
    after: Matrix
    revision: int | None


def optimise_map(path: Path, config: BackendConfig) -> Optimised:
    """Adjust all poses and landmarks of the map, and write the poses of the components that got better.

    The old poses stay where the new ones explain less of what was seen. Raises MapError when the map is in use, has no
    poses or cannot be read, SolverError when a component has no solution; nothing is written then.
    """
    with MapStore(path, existing=True) as store:
        poses = {number: row for number, row in store.load_poses().items() if row[0] is not None}
        if not poses:
            raise MapError(f"{path} has no poses that could be optimised")
        keyframes = {number: store.keyframe(number, (FEATURES,)) for number in poses}
        T = {number: np.array(row[0], np.float64) for number, row in poses.items()}
        scales = {number: row[2] for number, row in poses.items()}
        loops = store.load_loops()
        results, new = {}, dict(T)
        for component in sorted({row[1] for row in poses.values()}):
            members = [number for number, row in poses.items() if row[1] == component]
            if len(members) < LEAST_KEYFRAMES:
                continue
            mine = {number: T[number] for number in members}
            result = adjust([keyframes[number] for number in members], mine, scales, loops, config)
            results[component] = result
            if result.better:
                new |= carried(mine, dict(zip(result.keyframe_ids.tolist(), result.T_map_cam, strict=True)))
        ids = np.array(sorted(poses), np.int64)
        component_of = np.array([poses[number][1] for number in ids.tolist()], np.int64)
        before, after = (np.stack([table[number] for number in ids.tolist()]) for table in (T, new))
        revision = None
        if any(result.better for result in results.values()):
            revision = int(store.meta().get("revision", 0)) + 1
            sessions = np.array([keyframes[number].session for number in ids.tolist()], np.int64)
            sizes = np.array([scales[number] for number in ids.tolist()])
            store.update_poses(MapSnapshot(revision, ids, sessions, component_of, after, sizes, ()))
    stamps = np.array([keyframes[number].stamp_ns for number in ids.tolist()], np.int64)
    return Optimised(results, ids, stamps, component_of, before, after, revision)


def carried(old: Mapping[int, Matrix], new: Mapping[int, Matrix]) -> dict[int, Matrix]:
    """Return all poses anew: those without a new one move along with the nearest keyframe (by id) that has one."""
    known = np.array(sorted(new))
    out = {}
    for number, T in old.items():
        nearest = int(known[np.abs(known - number).argmin()])
        out[number] = new[nearest] @ se3.inverse(old[nearest]) @ T
    return out
