"""The map as the back end knows it between two optimisations."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from seamark.backend.graph_types import Estimate, Node
from seamark.backend.types import Loop, MapSnapshot
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]

StoredPose = tuple[Matrix | None, int, float]


class MapState:
    """Keyframes without features, with their last optimised poses; newer ones hang on these by odometry. Not locked."""

    def __init__(self) -> None:
        self.keyframes: dict[int, Keyframe] = {}
        self.revision = 0
        self._poses: dict[int, Matrix] = {}
        self._scales: dict[int, float] = {}
        self._components: dict[int, int] = {}  # of each session
        self._previous: dict[int, int | None] = {}
        self._first: dict[int, int] = {}
        self._last: dict[int, int] = {}

    def add(self, keyframe: Keyframe, pose: StoredPose | None = None) -> None:
        """Append a keyframe: at a pose from before (T_map_cam, component, scale), a new session in its own frame, else
        by its motion since the previous keyframe.
        """
        previous_id = keyframe.previous_id if keyframe.previous_id is not None else self._last.get(keyframe.session)
        self.keyframes[keyframe.id] = keyframe
        self._previous[keyframe.id] = previous_id
        self._first.setdefault(keyframe.session, keyframe.id)
        self._last[keyframe.session] = keyframe.id
        self._components.setdefault(keyframe.session, keyframe.session)
        if keyframe.T_odom_cam is None:
            return
        if pose is not None and pose[0] is not None:
            self._poses[keyframe.id], self._scales[keyframe.id] = pose[0], pose[2]
            self._components[keyframe.session] = pose[1]
            return
        self._hang(keyframe, previous_id)

    def _hang(self, keyframe: Keyframe, previous_id: int | None) -> None:
        """Give a keyframe the pose that odometry says."""
        assert keyframe.T_odom_cam is not None
        if previous_id is None:
            self._poses[keyframe.id], self._scales[keyframe.id] = keyframe.T_odom_cam, 1.0
            return
        T_odom_previous = self.keyframes[previous_id].T_odom_cam
        assert T_odom_previous is not None
        self._scales[keyframe.id] = self._scales[previous_id]
        self._poses[keyframe.id] = self._chain(previous_id, se3.inverse(T_odom_previous) @ keyframe.T_odom_cam)

    def take(self, estimate: Estimate) -> None:
        """Replace all poses by those of the solver; keyframes that it did not know yet hang on them by odometry."""
        self.revision = estimate.revision
        ids = estimate.keyframe_ids.tolist()
        since: list[int] = []
        if len(ids) < len(self._poses):
            known = set(ids)
            since = [keyframe_id for keyframe_id in self._poses if keyframe_id not in known]
        self._poses = dict(zip(ids, estimate.T_map_cam, strict=True))
        self._scales = dict(zip(ids, estimate.scales.tolist(), strict=True))
        for session, first in self._first.items():
            row = int(np.searchsorted(estimate.keyframe_ids, first))
            if row < len(ids) and ids[row] == first:
                self._components[session] = int(estimate.components[row])
        for keyframe_id in since:
            self._hang(self.keyframes[keyframe_id], self._previous[keyframe_id])

    @property
    def localised(self) -> bool:
        """Return whether the newest session lies in the frame of an earlier one, or is the first."""
        newest = max(self._components, default=0)
        return self._components.get(newest) != newest or newest == min(self._components)

    def components(self) -> dict[int, int]:
        """Return for each session the one in whose frame of reference its poses are."""
        return dict(self._components)

    def contract(self, nodes: Iterable[Node], components: Mapping[int, int]) -> None:
        """Keep these keyframes only, each hanging on its node's predecessor, at the poses that they have."""
        kept = {node.id: node for node in nodes}
        self.keyframes = {
            number: keyframe
            if keyframe.previous_id == kept[number].previous_id
            else replace(keyframe, previous_id=kept[number].previous_id)
            for number, keyframe in self.keyframes.items()
            if number in kept
        }
        self._poses = {number: pose for number, pose in self._poses.items() if number in kept}
        self._scales = {number: scale for number, scale in self._scales.items() if number in kept}
        self._components = dict(components)
        self._previous = {number: self.keyframes[number].previous_id for number in self.keyframes}
        self._first, self._last = {}, {}
        for number, keyframe in self.keyframes.items():
            self._first.setdefault(keyframe.session, number)
            self._last[keyframe.session] = number

    def estimate(self) -> Estimate:
        """Return all poses as a solver would give them."""
        snapshot = self.snapshot(())
        columns = (snapshot.keyframe_ids, snapshot.components, snapshot.T_map_cam, snapshot.scales)
        return Estimate(self.revision, *columns)

    def pose_of_neighbour(self, keyframe_id: int, T_keyframe_cam: Matrix) -> Matrix | None:
        """Return ``T_map_cam`` of a camera near a keyframe (translation in its units), None without poses."""
        if keyframe_id not in self._poses:
            return None
        return self._chain(keyframe_id, T_keyframe_cam)

    def snapshot(self, loops: tuple[Loop, ...]) -> MapSnapshot:
        """Return all keyframes by ascending id."""
        ids = sorted(self.keyframes)
        nowhere = np.full((4, 4), np.nan)
        sessions = [self.keyframes[i].session for i in ids]
        return MapSnapshot(
            revision=self.revision,
            keyframe_ids=np.array(ids, np.int64),
            sessions=np.array(sessions, np.int64),
            components=np.array([self._components[session] for session in sessions], np.int64),
            T_map_cam=np.array([self._poses.get(i, nowhere) for i in ids], np.float64).reshape(-1, 4, 4),
            scales=np.array([self._scales.get(i, 1.0) for i in ids], np.float64),
            loops=loops,
        )

    def _chain(self, keyframe_id: int, T_keyframe_cam: Matrix) -> Matrix:
        scaled = T_keyframe_cam.copy()
        scaled[:3, 3] *= self._scales[keyframe_id]
        return self._poses[keyframe_id] @ scaled
