"""What the back end takes and gives."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from seamark.backend.epipolar import Direction
from seamark.backend.evidence import Evidence

Matrix = NDArray[np.float64]


class Reason(StrEnum):
    """Why a place candidate became a loop or did not (column ``reason`` of loops.csv)."""

    ACCEPTED = "accepted"
    FEW_MATCHES = "few_matches"  # too few descriptor matches to try geometry
    FEW_INLIERS = "few_inliers"  # geometry explains too few of them
    BAD_GEOMETRY = "bad_geometry"  # degenerate, or inliers crowd in one spot
    CONTRADICTED = "contradicted"  # the pose leaves unexplained what else matches, or what should be seen is missing
    ODOMETRY_DISAGREES = "odometry_disagrees"  # contradicts the odometry's own uncertainty
    INCONSISTENT = "inconsistent"  # contradicts other loops
    UNCONFIRMED = "unconfirmed"  # plausible, but no second loop supports it


@dataclass(frozen=True, eq=False)
class Loop:
    """The verdict on one place candidate of one keyframe: a row of loops.csv.

    ``T_match_query`` (4, 4) maps the query camera's frame into the matched camera's; None where geometry gave none
    (rejected early, or mode places). For mono sessions its translation is in the scale of the match's session.
    ``covariance`` (6, 6) is in the query's frame. ``score votes jeffrey`` are the candidate's evidence, ``evidence`` is
    that of geometry: only when the loop is first told of, afterwards the map on disk has it.
    """

    query_id: int
    match_id: int
    accepted: bool
    reason: Reason
    inliers: int
    score: float
    votes: float
    jeffrey: float
    T_match_query: Matrix | None = None
    covariance: Matrix | None = None
    scale: float = 1.0
    evidence: Evidence | None = None


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """The whole map at one revision.

    ``keyframe_ids`` (N,) int64 ascending, ``sessions`` (N,) int64, ``T_map_cam`` (N, 4, 4), NaN where a keyframe has
    no pose.
    ``components`` (N,) int64: keyframes with the same number share one frame of reference (sessions joined by loops).
    ``scales`` (N,): how many map units one unit of the session's odometry is (1 for metric sessions).
    """

    revision: int
    keyframe_ids: NDArray[np.int64]
    sessions: NDArray[np.int64]
    components: NDArray[np.int64]
    T_map_cam: Matrix
    scales: NDArray[np.float64]
    loops: tuple[Loop, ...]


@dataclass(frozen=True, eq=False)
class Place:
    """One ranked answer to the question "have I been here?".

    ``inliers`` is 0 where geometry was not tried or failed. ``T_map_cam`` is the query camera's pose in the map, None
    when it was not localised. ``view`` is the likeness of the edges of the whole images, 0..1, ``probability`` that of
    both showing one place, by looks alone. ``direction``: how the query lies to keyframe ``keyframe_id``, but for the
    distance, where no depth told more.
    """

    keyframe_id: int
    session: int
    stamp_ns: int
    file: str
    score: float
    votes: float
    jeffrey: float
    inliers: int
    accepted: bool
    reason: Reason
    T_map_cam: Matrix | None = None
    view: float = 0.0
    probability: float = 0.0
    direction: Direction | None = None
