"""Optimising a map that no service has open: its pose graph, or everything that its keyframes have seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.bundle_adjustment import Adjusted, adjust
from seamark.backend.bundle_links import measured
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import chi_squared, cycle_error, similarity
from seamark.backend.errors import MapError
from seamark.backend.graph_types import Constraint
from seamark.backend.map_reader import FEATURES
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot
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

    What was found is written with them (see adjustment.py), so that a service that opens the map later does not lose it
    when it solves its pose graph. The old poses stay where the new ones explain less of what was seen. Raises MapError
    when the map is in use, has no poses or cannot be read, SolverError when a component has no solution; nothing is
    written then.
    """
    with MapStore(path, existing=True) as store:
        poses = {number: row for number, row in store.load_poses().items() if row[0] is not None}
        if not poses:
            raise MapError(f"{path} has no poses that could be optimised")
        keyframes = {number: store.keyframe(number, (FEATURES,)) for number in poses}
        T = {number: np.array(row[0], np.float64) for number, row in poses.items()}
        scales = {number: row[2] for number, row in poses.items()}
        loops = store.load_loops()
        results, new, found = {}, dict(T), []
        for component in sorted({row[1] for row in poses.values()}):
            members = [number for number, row in poses.items() if row[1] == component]
            if len(members) < LEAST_KEYFRAMES:
                continue
            mine = {number: T[number] for number in members}
            result = adjust([keyframes[number] for number in members], mine, scales, loops, config)
            results[component] = result
            if result.better:
                new |= carried(mine, dict(zip(result.keyframe_ids.tolist(), result.T_map_cam, strict=True)))
                scales |= dict(zip(result.keyframe_ids.tolist(), result.scales.tolist(), strict=True))
                there = {number: (new[number], scales[number]) for number in members}
                found.append(adjustment_of(result, there, loops, config.graph.cauchy_width))
        ids = np.array(sorted(poses), np.int64)
        component_of = np.array([poses[number][1] for number in ids.tolist()], np.int64)
        before, after = (np.stack([table[number] for number in ids.tolist()]) for table in (T, new))
        revision = None
        if any(result.better for result in results.values()):
            revision = int(store.meta().get("revision", 0)) + 1
            sessions = np.array([keyframes[number].session for number in ids.tolist()], np.int64)
            sizes = np.array([scales[number] for number in ids.tolist()])
            snapshot = MapSnapshot(revision, ids, sessions, component_of, after, sizes, ())
            store.record(snapshot=snapshot, adjustments=found)
    stamps = np.array([keyframes[number].stamp_ns for number in ids.tolist()], np.int64)
    return Optimised(results, ids, stamps, component_of, before, after, revision)


def adjustment_of(
    result: Adjusted, poses: Mapping[int, tuple[Matrix, float]], loops: Sequence[Loop], cauchy_width: float
) -> Adjustment:
    """Return what later pose graphs are to know: where each keyframe (T_map_cam and scale) of the component is.

    It rests on all accepted loops of the component; one that it contradicts counts as little as in its own solution.
    """
    motions = {}
    for number, before, C in zip(
        result.keyframe_ids.tolist(), result.previous_ids.tolist(), result.covariances, strict=True
    ):
        if before >= 0 and np.isfinite(C).all():
            unit = np.repeat([1.0, 1 / poses[number][1]], 3)  # from map units to those of the keyframe
            motions[number] = (before, C * unit[:, None] * unit)
    own = {number: AdjustedPose(T, scale, *motions.get(number, (None, None))) for number, (T, scale) in poses.items()}
    free = Adjustment(min(poses), own, {})
    weights = {}
    for loop, T_match_query, C in measured(loops):
        if {loop.query_id, loop.match_id} <= poses.keys():
            measured_motion = similarity(Constraint(loop.query_id, loop.match_id, T_match_query, C, loop.scale))
            E = np.linalg.inv(measured_motion) @ free.motion(loop.match_id, loop.query_id)
            chi2 = chi_squared(cycle_error(E[None])[0], C[None], np.zeros(1), np.ones(1))[0]
            weights[loop.query_id, loop.match_id] = 1 / (1 + float(chi2) / cauchy_width**2)
    return Adjustment(free.id, own, weights)


def carried(old: Mapping[int, Matrix], new: Mapping[int, Matrix]) -> dict[int, Matrix]:
    """Return all poses anew: those without a new one move along with the nearest keyframe (by id) that has one."""
    known = np.array(sorted(new))
    out = {}
    for number, T in old.items():
        nearest = int(known[np.abs(known - number).argmin()])
        out[number] = new[nearest] @ se3.inverse(old[nearest]) @ T
    return out
