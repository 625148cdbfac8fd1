"""Which features of a map's keyframes show the same point: tracks, made when they are asked for."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.map_reader import FEATURES
from seamark.backend.map_store import MapStore
from seamark.backend.matching import match_features
from seamark.frontend.types import Keyframe

MATCH_RATIO = 0.8
REPROJECTION_PX = 4.0

Observation = tuple[int, int]  # keyframe id, index of its feature


@dataclass(frozen=True)
class Point:
    """A point of the map: ``position`` (3,) in the map's frame, mean error in pixels, its views."""

    id: int
    position: NDArray[np.float64]
    error_px: float
    views: tuple[Observation, ...]


def posed(store: MapStore, component: int | None = None) -> dict[int, tuple[NDArray[np.float64], float]]:
    """Return T_map_cam and scale of the keyframes of one component, by default that of most keyframes."""
    poses = {number: pose for number, pose in store.load_poses().items() if pose[0] is not None}
    if component is None and poses:
        counted = np.unique([pose[1] for pose in poses.values()], return_counts=True)
        component = int(counted[0][np.argmax(counted[1])])
    return {number: (pose[0], pose[2]) for number, pose in sorted(poses.items()) if pose[1] == component}  # type: ignore[misc]


def points_of(store: MapStore, poses: dict[int, tuple[NDArray[np.float64], float]]) -> Iterator[Point]:
    """Yield the points that keyframes with poses see, each when its last view has passed.

    A keyframe is compared with the one before it in its session: a feature that matches, and whose landmark projects
    to it, goes on a track; others with a landmark begin one. Only the features of two keyframes are in memory.
    """
    open_tracks: dict[int, dict[int, _Track]] = {}  # session -> feature of its last keyframe -> track
    last: dict[int, Keyframe] = {}
    number = 0
    for keyframe_id in poses:
        keyframe = store.keyframe(keyframe_id, (FEATURES,))
        if len(keyframe.features) == 0 or keyframe.camera is None:
            continue
        world = _world(keyframe, poses[keyframe_id])
        before, tracks = last.get(keyframe.session), open_tracks.get(keyframe.session, {})
        going_on: dict[int, _Track] = {}
        if before is not None:
            matches = match_features(keyframe.features, before.features, MATCH_RATIO)
            pairs = zip(matches.query.tolist(), matches.match.tolist(), strict=True)
            going_on = {own: tracks.pop(other) for own, other in pairs if other in tracks}
            _prune(going_on, tracks, keyframe, poses[keyframe_id][0])
        for track in tracks.values():
            number += 1
            yield track.point(number)
        for index in np.flatnonzero(np.isfinite(world).all(axis=1)).tolist():
            track = going_on.setdefault(index, _Track([], [], []))
            track.positions.append(world[index])
            if len(track.views) == 0 or track.views[-1][0] != keyframe_id:
                track.views.append((keyframe_id, index))
        last[keyframe.session], open_tracks[keyframe.session] = keyframe, going_on
    for tracks in open_tracks.values():
        for track in tracks.values():
            number += 1
            yield track.point(number)


@dataclass
class _Track:
    positions: list[NDArray[np.float64]]
    views: list[Observation]
    errors_px: list[float]

    def point(self, number: int) -> Point:
        error = float(np.mean(self.errors_px)) if self.errors_px else 0.0
        return Point(number, np.median(self.positions, axis=0), error, tuple(self.views))


def _world(keyframe: Keyframe, pose: tuple[NDArray[np.float64], float]) -> NDArray[np.float64]:
    """Return the landmarks (N, 3) in the map's frame, NaN where unknown."""
    T_map_cam, scale = pose
    if len(keyframe.landmarks) != len(keyframe.features):
        return np.full((len(keyframe.features), 3), np.nan)
    return np.asarray(scale * keyframe.landmarks.astype(np.float64) @ T_map_cam[:3, :3].T + T_map_cam[:3, 3])


def _prune(
    going_on: dict[int, _Track], ended: dict[int, _Track], keyframe: Keyframe, T_map_cam: NDArray[np.float64]
) -> None:
    """Let tracks end here that do not project to the feature that they were matched with; add the view to the rest."""
    if not going_on or keyframe.camera is None:
        return
    own = list(going_on)
    X = np.array([np.median(going_on[index].positions, axis=0) for index in own])
    X_cam = (X - T_map_cam[:3, 3]) @ T_map_cam[:3, :3]
    ahead = X_cam[:, 2] > 0
    K = keyframe.camera.K
    depth = np.where(ahead, X_cam[:, 2], 1.0)
    projected = np.stack([K[0, 0] * X_cam[:, 0] / depth + K[0, 2], K[1, 1] * X_cam[:, 1] / depth + K[1, 2]], axis=1)
    seen = keyframe.camera.undistort(keyframe.features.points[own].astype(np.float64))
    errors = np.where(ahead, np.linalg.norm(projected - seen, axis=1), np.inf)
    for index, error in zip(own, errors.tolist(), strict=True):
        if error <= REPROJECTION_PX:
            going_on[index].errors_px.append(error)
            going_on[index].views.append((keyframe.id, index))
        else:
            ended[-1 - index] = going_on.pop(index)
