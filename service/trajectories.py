"""The trajectories of one run: as given at the frame, as the map corrects them, and one laid over the other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.types import MapSnapshot
from seamark.frontend import se3
from seamark.frontend.types import Matrix, Odometry
from seamark.service.evaluation import Similarity
from seamark.service.types import RunRecord, Trajectory


@dataclass(frozen=True, eq=False)
class Reference:
    """Where a keyframe is in the map: its pose, its component and the scale of its session."""

    T_map_cam: Matrix
    component: int
    scale: float

    def pose(self, T_reference_cam: Matrix) -> Matrix:
        """Return T_map_cam of a frame that is known relative to this keyframe."""
        T = T_reference_cam.copy()
        T[:3, 3] *= self.scale
        return self.T_map_cam @ T


def references(snapshot: MapSnapshot) -> dict[int, Reference]:
    """Return all keyframes of the map that have a pose, by their id."""
    return {
        int(id_): Reference(T, int(component), float(scale))
        for id_, component, T, scale in zip(
            snapshot.keyframe_ids, snapshot.components, snapshot.T_map_cam, snapshot.scales, strict=True
        )
        if np.isfinite(T).all()
    }


def all_references(record: RunRecord) -> dict[int, Reference]:
    """Return the references of a run; those that the map has forgotten hang on the last one kept of their session.

    Odometry poses are of the whole session, so that this costs no more than the drift between the two.
    """
    known = references(record.snapshot)
    last: dict[int, tuple[Reference, Matrix]] = {}
    for frame in sorted((one for one in record.odometry if one.keyframe_id is not None), key=lambda one: one.stamp_ns):
        number, T_odom_cam = frame.keyframe_id, frame.T_odom_cam
        if number is None or T_odom_cam is None:
            continue
        if number in known:
            last[frame.session] = known[number], T_odom_cam
        elif frame.session in last:
            reference, T_odom_reference = last[frame.session]
            pose = reference.pose(se3.inverse(T_odom_reference) @ T_odom_cam)
            known[number] = Reference(pose, reference.component, reference.scale)
    return known


def main_component(record: RunRecord) -> int | None:
    """Return the component with most frames of the input that have a pose; of equals the lowest. None without any."""
    known = all_references(record)
    counts: dict[int, int] = {}
    for reference_id, *_ in _frames(record.odometry):
        if reference_id in known:
            component = known[reference_id].component
            counts[component] = counts.get(component, 0) + 1
    return min(counts, key=lambda component: (-counts[component], component)) if counts else None


def main_session(odometry: tuple[Odometry, ...]) -> int | None:
    """Return the session with most frames that had a pose when they were given; of equals the lowest."""
    counts: dict[int, int] = {}
    for frame in odometry:
        if frame.T_odom_cam is not None:
            counts[frame.session] = counts.get(frame.session, 0) + 1
    return min(counts, key=lambda session: (-counts[session], session)) if counts else None


def corrected(record: RunRecord) -> Trajectory:
    """Return T_map_cam of every frame of the main component, ordered by stamp; frames without a pose are not in it."""
    known, component = all_references(record), main_component(record)
    poses: dict[int, tuple[int, Matrix]] = {}
    for reference_id, index, stamp_ns, T_reference_cam in _frames(record.odometry):
        reference = known.get(reference_id)
        if reference is not None and reference.component == component:
            # A frame's own pose comes later in the list than one filled in for it, and wins.
            poses[index] = (stamp_ns, reference.pose(T_reference_cam))
    return _trajectory([poses[index] for index in sorted(poses)])


def as_given(record: RunRecord, session: int | None = None) -> Trajectory:
    """Return T_odom_cam of the frames of one session, or of all of them, in input order."""
    return _trajectory(
        [
            (frame.stamp_ns, frame.T_odom_cam)
            for frame in record.odometry
            if frame.T_odom_cam is not None and session in (None, frame.session)
        ],
        ordered=False,
    )


def keyframes(record: RunRecord) -> Trajectory:
    """Return T_map_cam of the keyframes of the main component, ordered by stamp."""
    known, component = references(record.snapshot), main_component(record)
    return _trajectory(
        [
            (keyframe.stamp_ns, known[keyframe.id].T_map_cam)
            for keyframe in record.keyframes
            if keyframe.id in known and known[keyframe.id].component == component
        ]
    )


def odometry_in_map(record: RunRecord) -> list[Trajectory]:
    """Return, for every session of the main component, its odometry laid into the map at the session's first frame."""
    known, component = references(record.snapshot), main_component(record)
    anchors: dict[int, Similarity] = {}
    for frame in record.odometry:
        reference = known.get(frame.reference_id) if frame.reference_id is not None else None
        if frame.session in anchors or reference is None or reference.component != component:
            continue
        if frame.T_odom_cam is not None and frame.T_reference_cam is not None:
            anchors[frame.session] = _anchor(reference.pose(frame.T_reference_cam), frame.T_odom_cam, reference.scale)
    return [anchor.apply(as_given(record, session)) for session, anchor in anchors.items()]


def tracked(record: RunRecord) -> int:
    """Return the number of frames that have a pose, later filled ones included."""
    return len({index for _, index, *_ in _frames(record.odometry)})


def _anchor(T_map_cam: Matrix, T_odom_cam: Matrix, scale: float) -> Similarity:
    R = T_map_cam[:3, :3] @ T_odom_cam[:3, :3].T
    return Similarity(scale, R, T_map_cam[:3, 3] - scale * R @ T_odom_cam[:3, 3])


def _frames(odometry: tuple[Odometry, ...]) -> list[tuple[int, int, int, Matrix]]:
    """Return (reference id, index, stamp, T_reference_cam) of every known frame, filled ones first."""
    filled = [
        (one.reference_id, one.index, one.stamp_ns, one.T_reference_cam) for frame in odometry for one in frame.filled
    ]
    own = [
        (frame.reference_id, frame.index, frame.stamp_ns, frame.T_reference_cam)
        for frame in odometry
        if frame.reference_id is not None and frame.T_reference_cam is not None
    ]
    return filled + own


def _trajectory(poses: list[tuple[int, Matrix]], *, ordered: bool = True) -> Trajectory:
    if ordered:
        poses = sorted(poses, key=lambda pose: pose[0])
    stamps: NDArray[np.int64] = np.array([stamp for stamp, _ in poses], np.int64)
    return Trajectory(stamps, np.array([T for _, T in poses], np.float64).reshape(-1, 4, 4))
