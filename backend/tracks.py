"""Points of the scene that several keyframes see: matches joined to tracks."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.matching import match_features
from seamark.backend.pose_errors import Observations, errors
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]
NEIGHBOURS = 3  # keyframes back along the odometry with which each is matched
SLACK = 2.0  # of the reprojection error of an inlier: poses are what is to be mended


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations (M,) of tracks, by ascending track: ``track``, ``keyframe`` (ids) and ``feature`` (index there)."""

    track: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    feature: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Return the number of tracks."""
        return len(np.unique(self.track))


def neighbours(keyframes: Sequence[Keyframe]) -> list[tuple[int, int]]:
    """Return pairs (later, earlier) of keyframes that follow each other closely in one session."""
    chains: dict[int, list[int]] = {}
    pairs = []
    for keyframe in keyframes:
        chain = chains.setdefault(keyframe.session, [])
        pairs += [(keyframe.id, earlier) for earlier in chain[-NEIGHBOURS:]]
        chain.append(keyframe.id)
    return pairs


def find_tracks(
    keyframes: Mapping[int, Keyframe],
    pairs: Iterable[tuple[int, int]],
    T_relative: Mapping[tuple[int, int], Matrix],
    config: VerificationConfig,
) -> Tracks:
    """Match the pairs (query, match), keep what their relative pose explains, and join what hangs together.

    ``T_relative`` maps each pair to T_match_query in the units of their landmarks. A track that claims two features of
    one keyframe is wrong somewhere and is left out as a whole.
    """
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def root_of(node: tuple[int, int]) -> tuple[int, int]:
        root = node
        while parent.setdefault(root, root) != root:
            root = parent[root]
        while parent[node] != root:
            parent[node], node = root, parent[node]
        return root

    for query_id, match_id in pairs:
        query, match = keyframes[query_id], keyframes[match_id]
        for i, j in explained_matches(query, match, T_relative[query_id, match_id], config):
            a, b = root_of((query_id, i)), root_of((match_id, j))
            parent[max(a, b)] = min(a, b)
    return _tracks({node: root_of(node) for node in sorted(parent)})


def explained_matches(
    query: Keyframe, match: Keyframe, T_match_query: Matrix, config: VerificationConfig
) -> list[tuple[int, int]]:
    """Return the pairs of features that match and lie where the relative pose and a landmark of either put them."""
    if query.camera is None or match.camera is None or not len(query.landmarks) or not len(match.landmarks):
        return []
    matches = match_features(query.features, match.features, config.match_ratio)
    seen = Observations(
        query.landmarks[matches.query].astype(np.float64),
        match.landmarks[matches.match].astype(np.float64),
        query.camera.undistort(query.features.points[matches.query]),
        match.camera.undistort(match.features.points[matches.match]),
        query.camera,
        match.camera,
    )
    good = errors(T_match_query, seen) < SLACK * config.reprojection_px
    return list(zip(matches.query[good].tolist(), matches.match[good].tolist(), strict=True))


def relative_pose(T_map_cam: Mapping[int, Matrix], scales: Mapping[int, float], query_id: int, match_id: int) -> Matrix:
    """Return T_match_query of the map, in the match's units."""
    T = se3.inverse(T_map_cam[match_id]) @ T_map_cam[query_id]
    T[:3, 3] /= scales[match_id]
    return T


def _tracks(roots: Mapping[tuple[int, int], tuple[int, int]]) -> Tracks:
    members: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for node, root in roots.items():
        members.setdefault(root, []).append(node)
    rows = []
    number = 0
    for nodes in members.values():
        if len(nodes) >= 2 and len({keyframe for keyframe, _ in nodes}) == len(nodes):
            rows += [(number, *node) for node in nodes]
            number += 1
    table = np.array(rows, np.int64).reshape(-1, 3)
    return Tracks(table[:, 0], table[:, 1], table[:, 2])
