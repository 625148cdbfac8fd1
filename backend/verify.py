"""Geometric verification: do two keyframes show the same place, and how do their cameras lie to each other?"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.coverage import coverage
from seamark.backend.epipolar import Direction, Views, direction_of, fit_epipolar
from seamark.backend.evidence import Evidence, Gate
from seamark.backend.far_landmarks import Landmarks, measured_landmarks
from seamark.backend.matching import Matches, match_features
from seamark.backend.pose_errors import Observations
from seamark.backend.refine_pose import RefinedPose, explained_without_depth, refine, worst_deviations
from seamark.backend.types import Reason
from seamark.backend.verify_pose import Hypothesis, estimate_pose, estimate_scale
from seamark.backend.visibility import Sight, look
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]
FarLandmarks = Callable[[Keyframe], Landmarks]

NEARLY_ALL = 0.8
FARTHER = 1.25  # times as many matches must have a landmark to try again
CLOSE_DESCRIPTORS = 60.0  # of 512: two that differ by less are of one thing, however alike the other matches are


@dataclass(frozen=True, eq=False)
class Verification:
    """Two keyframes show the same place.

    ``T_match_query`` (4, 4) with translation in the match's units and ``covariance`` (6, 6) in the query's frame and
    units, rotation first; both None where the geometry tells the place only (no depth, or no calibration). ``scale``
    is match units per query unit with ``scale_sigma`` of its logarithm, infinite where it could not be measured.
    """

    inliers: int
    matches: int
    T_match_query: Matrix | None = None
    covariance: Matrix | None = None
    scale: float = 1.0
    scale_sigma: float = 1e-3
    evidence: Evidence | None = None

    @property
    def direction(self) -> Direction | None:
        """Return the pose without its length, where there is no other and the views hold this one."""
        return None if self.evidence is None else self.evidence.direction


@dataclass(frozen=True)
class Rejected:
    """Geometry does not support that two keyframes show the same place, and why."""

    reason: Reason
    inliers: int
    matches: int
    evidence: Evidence | None = field(default=None, compare=False)


def verify(
    query: Keyframe, match: Keyframe, config: VerificationConfig, seed: int, far: FarLandmarks = measured_landmarks
) -> Verification | Rejected:
    """Compare two keyframes by descriptors, then by the geometry that is known of them.

    With calibration and depth on either side: pose from 3D-2D pairs. With calibration only: essential matrix, else
    fundamental matrix; these tell the place and no metric pose. Where what the sensors measured yields no pose, ``far``
    is asked for landmarks beyond their reach. The same input and ``seed`` give the same result.
    """
    matches = match_features(query.features, match.features, config.match_ratio)
    trial = _Trial(query, match, matches, config, measured_landmarks)
    if not trial.passes("matches", len(matches), config.min_matches):
        return trial.rejected(Reason.FEW_MATCHES)
    if query.camera is None or match.camera is None:
        return _verify_epipolar(trial, seed)
    result = _verify_pose(trial, seed) if trial.depth_pairs >= config.min_inliers else _verify_epipolar(trial, seed)
    if isinstance(result, Verification) and result.T_match_query is not None:
        return result
    farther = _Trial(query, match, matches, config, far)
    if farther.depth_pairs < max(config.min_inliers, FARTHER * trial.depth_pairs):
        return result
    farther.passes("matches", len(matches), config.min_matches)
    again = _verify_pose(farther, seed)
    return again if isinstance(again, Verification) or isinstance(result, Rejected) else result


def pair_seed(seed: int, query_id: int, match_id: int) -> int:
    """Return a seed for one pair, so that a result does not depend on what was verified before."""
    return (seed * 1_000_003 + (query_id + 2) * 7_919 + match_id) & 0x7FFFFFFF


class _Trial:
    """One comparison on its way through the gates."""

    def __init__(
        self, query: Keyframe, match: Keyframe, matches: Matches, config: VerificationConfig, far: FarLandmarks
    ) -> None:
        self.query, self.match, self.matches, self.config = query, match, matches, config
        self.of_query, self.of_match = far(query), far(match)
        self.inliers: Flags = np.zeros(len(matches), bool)
        self.explained: Flags = np.zeros(len(matches), bool)  # without depth
        self.reprojection_px = float("nan")
        self.missing = np.zeros((0, 2), np.float32)
        self._gates: list[Gate] = []

    @property
    def depth_pairs(self) -> int:
        """How many matches have a landmark on the side that has more of them."""
        return int(max(self.of_query.known[self.matches.query].sum(), self.of_match.known[self.matches.match].sum()))

    @property
    def X_query(self) -> Matrix:
        """The landmarks (M, 3) of the matches in the query, NaN where unknown."""
        return self.of_query.points[self.matches.query]

    @property
    def X_match(self) -> Matrix:
        """The landmarks (M, 3) of the matches in the match, NaN where unknown."""
        return self.of_match.points[self.matches.match]

    @property
    def count(self) -> int:
        return int(self.inliers.sum())

    def passes(self, name: str, value: float, limit: float, least: bool = True) -> bool:
        """Write down a gate and return whether it lets the candidate through."""
        self._gates.append(Gate(name, float(value), float(limit), least))
        return self._gates[-1].passed

    def evidence(self) -> Evidence:
        pixels = np.hstack(
            [self.query.features.points[self.matches.query], self.match.features.points[self.matches.match]]
        )
        return Evidence(pixels, self.inliers | self.explained, tuple(self._gates), self.reprojection_px, self.missing)

    def rejected(self, reason: Reason) -> Rejected:
        return Rejected(reason, self.count, len(self.matches), self.evidence())


def _verify_pose(trial: _Trial, seed: int) -> Verification | Rejected:
    """Estimate the pose from either side's landmarks, refine the better one with both, and look whether it holds."""
    query, match, config = trial.query, trial.match, trial.config
    best = _best_hypothesis(trial, seed)
    if best is None:
        trial.passes("inliers", 0, config.min_inliers)
        return trial.rejected(Reason.FEW_INLIERS)
    metric = query.metric and match.metric
    seen = _observations(trial, best, metric)
    refined = refine(best.T_match_query, seen, config)
    trial.inliers = best.inliers if refined is None else refined.inliers
    if not trial.passes("inliers", trial.count, config.min_inliers):
        return trial.rejected(Reason.FEW_INLIERS)
    if not trial.passes("inlier_ratio", trial.count / max(best.pairs, 1), config.min_inlier_ratio):
        return trial.rejected(Reason.FEW_INLIERS)
    if not _well_spread(trial) or refined is None:
        return trial.rejected(Reason.BAD_GEOMETRY)
    trial.reprojection_px = refined.reprojection_px
    if not _well_held(trial, refined):
        return trial.rejected(Reason.BAD_GEOMETRY)
    explained, others = explained_without_depth(refined.T_match_query, seen, config.reprojection_px)
    trial.explained = explained
    # Shares are smoothed, so that one or two matches decide nothing.
    if not trial.passes("explained_without_depth", (explained.sum() + 2) / (others.sum() + 2), config.min_explained):
        return trial.rejected(Reason.CONTRADICTED)
    sight = _look(trial, refined, best.in_query_units)
    trial.missing = sight.pixels[sight.found < 0].astype(np.float32) if not best.in_query_units else trial.missing
    if not trial.passes("confirmed", (sight.confirmed + 2) / (sight.expected + 2), config.min_confirmed):
        return trial.rejected(Reason.CONTRADICTED)
    T_match_query, covariance, scale, scale_sigma = refined.T_match_query, refined.covariance.copy(), 1.0, 1e-3
    if not metric:
        scale, scale_sigma = estimate_scale(
            T_match_query, best.in_query_units, trial.inliers, trial.X_query, trial.X_match, config.min_scale_pairs
        )
        if best.in_query_units and np.isfinite(scale_sigma):
            T_match_query = T_match_query.copy()
            T_match_query[:3, 3] *= scale
        elif best.in_query_units:
            return trial.rejected(Reason.BAD_GEOMETRY)
        else:
            # A tangent vector of the query's frame is in the query's units.
            covariance[3:, :] /= scale
            covariance[:, 3:] /= scale
    return Verification(
        trial.count, len(trial.matches), T_match_query, covariance, scale, scale_sigma, trial.evidence()
    )


def _well_held(trial: _Trial, refined: RefinedPose) -> bool:
    """Return whether the matches hold the pose, and would without any one of them.

    A few far ones in a corner leave it free to swing about them; one other, right or wrong, then decides how it lies.
    """
    for name, deviations in (
        ("sigma", worst_deviations(refined.covariance[None])),
        ("sigma_without_one", refined.without_one),
    ):
        rotation, translation = np.rad2deg(deviations[0]), deviations[1] / refined.depth
        if not trial.passes(f"rotation_{name}_deg", rotation, trial.config.max_rotation_sigma_deg, least=False):
            return False
        limit = trial.config.max_translation_sigma_fraction
        if not trial.passes(f"translation_{name}_per_depth", translation, limit, least=False):
            return False
    return True


def _best_hypothesis(trial: _Trial, seed: int) -> Hypothesis | None:
    """Estimate the pose with the match's and with the query's landmarks; more inliers win, the match's on a tie.

    In one unit of length both sides are refined together: there the first is enough when it explains nearly all.
    """
    query, match, config = trial.query, trial.match, trial.config
    assert query.camera is not None and match.camera is not None
    X_match, X_query = trial.X_match, trial.X_query
    uv_query = query.camera.undistort(query.features.points[trial.matches.query])
    first = estimate_pose(X_match, uv_query, query.camera, config, seed, in_query_units=False)
    if first is not None and query.metric and match.metric:
        enough = NEARLY_ALL * max(first.pairs, int(np.isfinite(X_query).all(axis=1).sum()))
        if first.inliers.sum() >= enough:
            return first
    uv_match = match.camera.undistort(match.features.points[trial.matches.match])
    second = estimate_pose(X_query, uv_match, match.camera, config, seed, in_query_units=True)
    found = [pose for pose in (first, second) if pose is not None]
    return max(found, key=lambda pose: int(pose.inliers.sum()), default=None)


def _observations(trial: _Trial, best: Hypothesis, metric: bool) -> Observations:
    """Return what both sides have measured; without a common unit only the landmarks that the pose came from."""
    query, match = trial.query, trial.match
    assert query.camera is not None and match.camera is not None
    X_query, X_match = trial.X_query, trial.X_match
    if not metric and best.in_query_units:
        X_match = np.full_like(X_match, np.nan)
    elif not metric:
        X_query = np.full_like(X_query, np.nan)
    return Observations(
        X_query,
        X_match,
        query.camera.undistort(query.features.points[trial.matches.query]),
        match.camera.undistort(match.features.points[trial.matches.match]),
        query.camera,
        match.camera,
        trial.of_query.sigma[trial.matches.query],
        trial.of_match.sigma[trial.matches.match],
    )


def _look(trial: _Trial, refined: RefinedPose, in_query_units: bool) -> Sight:
    """Look in one view for the landmarks of the other that the pose was found from."""
    sides = (trial.query, trial.of_query), (trial.match, trial.of_match)
    (owner, landmarks), (viewer, measured_by) = sides if in_query_units else sides[::-1]
    assert owner.camera is not None and viewer.camera is not None
    T = refined.T_match_query if in_query_units else se3.inverse(refined.T_match_query)
    rows, columns = trial.matches.query[trial.inliers], trial.matches.match[trial.inliers]
    difference = trial.query.features.descriptors[rows].astype(np.float32)
    difference -= trial.match.features.descriptors[columns].astype(np.float32)
    reach = max(1.5 * float(np.median(np.linalg.norm(difference, axis=1))), CLOSE_DESCRIPTORS)
    measured = measured_by.points
    if not (owner.metric and viewer.metric):
        measured = np.full_like(measured, np.nan)
    return look(T, owner.features, landmarks.points, owner.camera, viewer.features, measured, viewer.camera, reach)


def _verify_epipolar(trial: _Trial, seed: int) -> Verification | Rejected:
    """Fit the essential (calibrated) or fundamental matrix and count what it explains: a direction at most."""
    query, match, config = trial.query, trial.match, trial.config
    points_query = query.features.points[trial.matches.query].astype(np.float64)
    points_match = match.features.points[trial.matches.match].astype(np.float64)
    views = Views(points_query, points_match, None)
    if query.camera is not None and match.camera is not None:
        cameras = query.camera, match.camera
        views = Views(cameras[0].undistort(points_query), cameras[1].undistort(points_match), cameras)
    model, trial.inliers = fit_epipolar(views, config, seed)
    if not trial.passes("epipolar_inliers", trial.count, config.min_epipolar_inliers):
        return trial.rejected(Reason.FEW_INLIERS)
    if not trial.passes("epipolar_ratio", trial.count / len(trial.matches), config.min_epipolar_ratio):
        return trial.rejected(Reason.FEW_INLIERS)
    if not _well_spread(trial):
        return trial.rejected(Reason.BAD_GEOMETRY)
    evidence = trial.evidence()
    if model is not None and views.cameras is not None:
        evidence = replace(evidence, direction=direction_of(model, views, trial.inliers, config))
    return Verification(trial.count, len(trial.matches), scale_sigma=float("inf"), evidence=evidence)


def _well_spread(trial: _Trial) -> bool:
    """Return whether the inliers neither crowd in one spot nor lie on a line, in both images."""
    config = trial.config
    for name, keyframe, indices in (
        ("query", trial.query, trial.matches.query[trial.inliers]),
        ("match", trial.match, trial.matches.match[trial.inliers]),
    ):
        cells, hull = coverage(keyframe.features.points, keyframe.features.points[indices], keyframe.camera)
        if not trial.passes(f"cells_{name}", cells, config.min_cells):
            return False
        if not trial.passes(f"hull_{name}", hull, config.min_hull_fraction):
            return False
    return True
