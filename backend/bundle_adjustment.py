"""Full bundle adjustment of a map: all poses and landmarks together (Triggs et al., "Bundle Adjustment", 1999).

Landmarks are tracks of matches between odometry neighbours and over accepted loops. Where depth was measured it counts
as the disparity of a narrow pair of eyes, whose error is Gaussian at any distance. A first round hardly looks at depth:
against its points the warp and the noise of depth are measured (depth_errors.py), which the second round is told.
Odometry, which has seen the frames between keyframes, counts too, for landmarks share errors that no number of them
averages out, and so do loops, but for those whose matches are tracks here: these would count twice. Landmarks are
eliminated first (Schur), by the ordering. To be run in a process that answers nobody.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from seamark.backend.bundle_links import followers, measured, motion_covariances, odometry_links, pose_of, reweighed
from seamark.backend.bundle_observations import Observations
from seamark.backend.config import BackendConfig
from seamark.backend.depth_errors import Depths, measure, parallax_sigma
from seamark.backend.errors import SolverError
from seamark.backend.graph_types import Constraint
from seamark.backend.tracks import Tracks, find_tracks, neighbours, relative_pose
from seamark.backend.types import Loop
from seamark.frontend.camera import Camera
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]

EYES_M = 0.1  # between the eyes that a measured depth is expressed by
HUBER = 1.345
ODOMETRY_HUBER = 3.0  # of six numbers at once; single motions may be far worse than the rest
OUTLIER = 4.0  # standard deviations beyond which an observation is dropped before the second round
HELD_BY = 30  # tracks between neighbours below which what the map says joins them where odometry has no length
LOST_PX = 50.0  # an observation whose landmark lies behind the camera counts as so far off
RAYLEIGH = 1.1774  # median length of a vector of two normal errors of deviation 1
WEAK_DEPTH = 10.0  # deviation of inverse depth, per median, in the first round
FIRST_TOLERANCE = 1e-3  # relative change of the error that ends the first round
PRIOR_SIGMA = 1e-4


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses ``T_map_cam`` (N, 4, 4) of ``keyframe_ids`` (N,), and how well they explain what was seen.

    ``scales`` (N,) are map units per unit of a keyframe's landmarks, ``covariances`` (N, 6, 6) of the motions since the
    keyframe before in ``previous_ids`` (N,), NaN and -1 at the first of a session. Errors are median and RMS over the
    same observations before and after, in pixels.
    """

    keyframe_ids: NDArray[np.int64]
    T_map_cam: Matrix
    scales: NDArray[np.float64]
    previous_ids: NDArray[np.int64]
    covariances: Matrix
    landmarks: int
    observations: int
    dropped: int
    median_px: tuple[float, float]
    rms_px: tuple[float, float]
    iterations: int

    @property
    def better(self) -> bool:
        """Return whether the new poses explain the observations better than the old ones."""
        return bool(np.isfinite(self.T_map_cam).all() and self.rms_px[1] < self.rms_px[0])


def adjust(
    keyframes: Sequence[Keyframe],
    T_map_cam: Mapping[int, Matrix],
    scales: Mapping[int, float],
    loops: Sequence[Loop],
    config: BackendConfig,
) -> Adjusted:
    """Adjust one component: keyframes with features and a pose, and the accepted loops between them.

    Raises SolverError where no landmarks join the keyframes, or no finite solution is found.
    """
    known = {k.id: k for k in keyframes if len(k.features) and k.camera is not None and k.id in T_map_cam}
    T_relative = {pair: relative_pose(T_map_cam, scales, *pair) for pair in neighbours(list(known.values()))}
    closed = [
        Constraint(x.query_id, x.match_id, T, C)
        for x, T, C in measured(loops)
        if {x.query_id, x.match_id} <= known.keys()
    ]
    T_relative |= {loop.key: loop.T_match_query for loop in closed}
    tracks = find_tracks(known, T_relative.keys(), T_relative, config.verification)
    if tracks.count < 10:
        raise SolverError(f"{tracks.count} landmarks are seen by two keyframes of {len(known)}: too few to adjust")
    problem = _Problem(known, T_map_cam, scales, tracks, closed, config)
    start = problem.seen.initial(T_map_cam)
    kept = np.ones(len(tracks.track), bool)
    first = problem.solve(start, kept, FIRST_TOLERANCE)
    kept = problem.within(first.values)
    problem.learn_noise(first.values, kept)
    problem.learn_depth(first.values, kept)
    problem.learn_odometry(first.values)
    second = problem.solve(problem.placed(first.values), kept)
    values = second.values
    before, after = (np.minimum(problem.seen.errors_px(which)[kept], LOST_PX) for which in (start, values))
    ids = np.array(sorted(known), np.int64)
    poses = np.stack([values.atPose3(X(number)).matrix() for number in ids.tolist()])
    if not np.isfinite(poses).all():
        raise SolverError(f"the adjustment of {len(ids)} keyframes has no finite solution")
    previous_ids, covariances = motion_covariances(second.graph, values, known)
    return Adjusted(
        ids,
        poses,
        problem.scales(values, kept),
        previous_ids,
        covariances,
        tracks.count,
        int(kept.sum()),
        int((~kept).sum()),
        (float(np.median(before)), float(np.median(after))),
        (float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2)))),
        first.iterations + second.iterations,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    values: gtsam.Values
    graph: gtsam.NonlinearFactorGraph
    iterations: int


class _Problem:
    """One adjustment: what was seen, as arrays in the order of the tracks' observations."""

    def __init__(
        self,
        keyframes: Mapping[int, Keyframe],
        T_map_cam: Mapping[int, Matrix],
        scales: Mapping[int, float],
        tracks: Tracks,
        loops: Sequence[Constraint],
        config: BackendConfig,
    ) -> None:
        self._keyframes, self._T, self._tracks, self._config = keyframes, T_map_cam, tracks, config
        self.seen, self._scales = Observations(keyframes, tracks, scales), scales
        inverse = 1 / self.seen.points[:, 2]
        usual = float(np.nanmedian(inverse)) if np.isfinite(inverse).any() else 1.0
        self._depths = Depths(inverse, WEAK_DEPTH * usual)
        self._metric = all(keyframe.metric for keyframe in keyframes.values())
        self._sigma_px = config.verification.noise_px
        self._loops = loops if self._metric else []
        self._steps = odometry_links(keyframes, loops, config.drift) if self._metric else []
        # What errors of one view have in common no number of key points averages out (the design effect of Kish 1965).
        in_common = config.verification.shared_share * (len(tracks.track) / len(keyframes) - 1)
        self._spread = float(np.sqrt(1 + max(in_common, 0.0)))
        self._cameras = {number: _calibration(keyframe) for number, keyframe in keyframes.items()}

    def within(self, values: gtsam.Values) -> NDArray[np.bool_]:
        """Return which observations (M,) are no outliers."""
        return self.seen.within(values, OUTLIER, self._sigma_px)

    def learn_noise(self, values: gtsam.Values, kept: NDArray[np.bool_]) -> None:
        """Take the noise of key points from what a solution leaves, if that is more than expected."""
        left = float(np.median(self.seen.errors_px(values)[kept])) / RAYLEIGH
        self._sigma_px = max(self._sigma_px, left)

    def learn_depth(self, values: gtsam.Values, kept: NDArray[np.bool_]) -> None:
        """Take the warp and the noise of depth from a solution that hardly looked at it."""
        if not self._metric or not np.isfinite(self.seen.points[:, 2]).any():
            return
        centres, focal = np.zeros((len(self.seen.pixels), 3)), np.zeros(len(self.seen.pixels))
        models: dict[Camera, int] = {}
        camera = np.zeros(len(self.seen.pixels), np.int64)
        for number, keyframe in self._keyframes.items():
            mine = self._tracks.keyframe == number
            assert keyframe.camera is not None
            centres[mine], focal[mine] = values.atPose3(X(number)).translation(), keyframe.camera.fx
            camera[mine] = models.setdefault(keyframe.camera, len(models))
        points = self.seen.landmarks(values)[self._tracks.track]
        sigma = parallax_sigma(centres, points, self._tracks.track, self._sigma_px, focal)
        solved = 1 / self.seen.depths(values)
        inverse = 1 / self.seen.points[:, 2]
        self._depths = measure(inverse, solved, sigma, kept, self.seen.pixels, list(models), camera, self._spread)

    def placed(self, values: gtsam.Values) -> gtsam.Values:
        """Return the solution with landmarks where the depths, as far as they are known now, have them."""
        return self.seen.placed_by(self._depths.inverse, values) if self._metric else values

    def learn_odometry(self, values: gtsam.Values) -> None:
        """Take from the same solution how much odometry errs."""
        if self._steps:
            solved = {number: values.atPose3(X(number)).matrix() for number in self._keyframes}
            z = self.seen.points[:, 2]
            depth = float(np.nanmedian(z)) if np.isfinite(z).any() else 1.0
            self._steps = reweighed(self._steps, solved, self._depths.warp, depth)

    def scales(self, values: gtsam.Values, kept: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the map units (N,) per unit of each keyframe's landmarks, by ascending id.

        Sessions without metric scale have landmarks in units of their own: how long they are the solution shows.
        """
        scales = np.array([self._scales[number] for number in sorted(self._keyframes)])
        if self._metric:
            return scales
        with np.errstate(invalid="ignore"):
            ratio = self.seen.depths(values) / self.seen.points[:, 2]
        for row, number in enumerate(sorted(self._keyframes)):
            mine = ratio[kept & (self._tracks.keyframe == number)]
            mine = mine[np.isfinite(mine) & (mine > 0)]
            if len(mine) >= HELD_BY:
                scales[row] *= float(np.median(mine))
        return scales

    def solve(self, start: gtsam.Values, kept: NDArray[np.bool_], tolerance: float = 1e-5) -> _Solution:
        """Return the solution with the kept observations."""
        graph = gtsam.NonlinearFactorGraph()
        robust = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
        flat = gtsam.noiseModel.Robust.Create(
            robust, gtsam.noiseModel.Isotropic.Sigma(2, self._sigma_px * self._spread)
        )
        depth = self._depth_noise(robust, self._depths.sigma)
        values, landmarks, poses = gtsam.Values(), set(), sorted(self._keyframes)
        for row, track, number in zip(
            np.flatnonzero(kept), self._tracks.track[kept].tolist(), self._tracks.keyframe[kept].tolist(), strict=True
        ):
            u, v = self.seen.pixels[row]
            mono, stereo = self._cameras[number]
            inverse = self._depths.inverse[row]
            if self._metric and np.isfinite(inverse):
                seen = gtsam.StereoPoint2(u, u - mono.fx() * EYES_M * inverse, v)
                graph.add(gtsam.GenericStereoFactor3D(seen, depth[number], X(number), L(track), stereo))
            else:
                graph.add(gtsam.GenericProjectionFactorCal3_S2((u, v), flat, X(number), L(track), mono))
            landmarks.add(track)
        for track in sorted(landmarks):
            values.insert(L(track), start.atPoint3(L(track)))
        for number in poses:
            values.insert(X(number), start.atPose3(X(number)))
        self._hold(graph, values, kept)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._config.graph.batch_iterations)
        parameters.setRelativeErrorTol(tolerance)
        keys = [X(number) for number in poses]
        parameters.setOrdering(gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, keys))
        try:
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
            solved = optimizer.optimize()
        except RuntimeError as error:
            raise SolverError(f"the adjustment of {len(poses)} keyframes has no solution: {error}") from error
        return _Solution(solved, graph, int(optimizer.iterations()))

    def _depth_noise(self, robust: gtsam.noiseModel.mEstimator.Base, sigma: float) -> dict[int, gtsam.noiseModel.Base]:
        """Return for each keyframe the noise of (left, right, row): right is left less the disparity."""
        noise = {}
        for number, (mono, _) in self._cameras.items():
            left = (self._spread * self._sigma_px) ** 2
            disparity = (self._spread * mono.fx() * EYES_M * sigma) ** 2
            covariance = np.array([[left, left, 0], [left, left + disparity, 0], [0, 0, left]])
            gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
            noise[number] = gtsam.noiseModel.Robust.Create(robust, gaussian)
        return noise

    def _hold(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kept: NDArray[np.bool_]) -> None:
        """Fix the gauge, and join by odometry what too few landmarks hold."""
        poses = sorted(self._keyframes)
        sigma = gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA)
        graph.add(gtsam.PriorFactorPose3(X(poses[0]), values.atPose3(X(poses[0])), sigma))
        if not self._metric:  # and the scale: the farthest keyframe keeps its place
            places = np.stack([self._T[number][:3, 3] for number in poses])
            far = poses[int(np.linalg.norm(places - places[0], axis=1).argmax())]
            held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
            graph.add(gtsam.PoseTranslationPrior3D(X(far), values.atPose3(X(far)).translation(), held))
        seen = self._tracks_of(kept)
        for loop in self._loops:
            if len(seen[loop.query_id] & seen[loop.match_id]) >= self._config.verification.min_inliers:
                continue  # its pose was made of the same matches
            robust = gtsam.noiseModel.mEstimator.Cauchy.Create(self._config.graph.cauchy_width)
            noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Gaussian.Covariance(loop.covariance))
            graph.add(gtsam.BetweenFactorPose3(X(loop.match_id), X(loop.query_id), pose_of(loop.T_match_query), noise))
        for before, number, T, covariance in self._steps:
            robust = gtsam.noiseModel.mEstimator.Huber.Create(ODOMETRY_HUBER)
            noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Gaussian.Covariance(covariance))
            graph.add(gtsam.BetweenFactorPose3(X(before), X(number), pose_of(T), noise))
        if not self._metric:
            self._join(graph, values, seen)

    def _tracks_of(self, kept: NDArray[np.bool_]) -> dict[int, set[int]]:
        """Return which tracks each keyframe sees."""
        seen: dict[int, set[int]] = {number: set() for number in self._keyframes}
        for track, number in zip(self._tracks.track[kept].tolist(), self._tracks.keyframe[kept].tolist(), strict=True):
            seen[number].add(track)
        return seen

    def _join(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, seen: Mapping[int, set[int]]) -> None:
        """Join neighbours that too few landmarks hold as the map has them: odometry without a length says little."""
        weak = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([np.deg2rad(0.5), 0.02], 3))
        for before, number in followers(self._keyframes):
            if len(seen[number] & seen[before]) < HELD_BY:
                motion = values.atPose3(X(before)).between(values.atPose3(X(number)))
                graph.add(gtsam.BetweenFactorPose3(X(before), X(number), motion, weak))


def _calibration(keyframe: Keyframe) -> tuple[gtsam.Cal3_S2, gtsam.Cal3_S2Stereo]:
    camera = keyframe.camera
    assert camera is not None
    numbers = (camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    return gtsam.Cal3_S2(*numbers), gtsam.Cal3_S2Stereo(*numbers, EYES_M)
