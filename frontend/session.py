"""One session's tracking state: live tracks, landmarks, and the window of recent keyframes."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.detectors import find_corners
from seamark.frontend.masks import Mask
from seamark.frontend.parallax import triangulate_tracks
from seamark.frontend.pose import PoseEstimate, Prediction, motion_covariance
from seamark.frontend.presumed import SPREAD, presume
from seamark.frontend.pyramid import Pyramid
from seamark.frontend.residuals import Observations
from seamark.frontend.revisit import find_again, worth_revisiting
from seamark.frontend.tracks import TrackAges, Tracks
from seamark.frontend.two_view import normalised_rays
from seamark.frontend.window import LandmarkTable, WindowKeyframe, adjust, bundle_of

OUTLIER_PX = 4.0
LIVE_KEYFRAMES = 2  # the newest of the window, whose landmarks are tracked still if they are seen
TRIANGULATED_SPREAD = 0.2  # a distance less certain than this is triangulated anew where two views allow it
NEAR_SPREAD = 0.1  # of the distance: what is known so well holds the translation
NOISE_UPDATE = 0.1  # weight of the newest frame in the running noise
GATE_NOISES = 4.0
NARROWEST_GATE_PX = 0.7
PREDICTION_SHARE = 0.5  # of the last step and
PREDICTION_OF_DEPTH = 0.02  # of the depth of the scene: how far constant velocity may be wrong


@dataclass(eq=False)
class Session:
    """Mutable state between frames.

    ``velocity`` is T_last_next of the last step, ``reference`` the newest keyframe, ``mapped`` the newest that the map
    knows as well: the window wants more of them than a map is worth. ``archive`` are those that have left the window,
    and ``anchors`` the archived ones whose landmarks the newest keyframe sees again.
    """

    id: int
    config: FrontendConfig
    camera: Camera
    metric: bool
    T_odom_cam: NDArray[np.float64]
    depth_offset: DepthOffset
    tracks: Tracks = field(default_factory=Tracks.none)
    landmarks: LandmarkTable = field(default_factory=LandmarkTable)
    window: list[WindowKeyframe] = field(default_factory=list)
    archive: list[WindowKeyframe] = field(default_factory=list)
    anchors: list[WindowKeyframe] = field(default_factory=list)
    mapped: WindowKeyframe | None = None
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    last_pose_stamp_ns: int = 0
    n_at_keyframe: int = 0
    noise_px: float | None = None
    next_track_id: int = 0
    ages: TrackAges = field(default_factory=TrackAges)

    @property
    def reference(self) -> WindowKeyframe:
        """Return the newest keyframe."""
        return self.window[-1]

    def new_tracks(self, pixels: NDArray[np.float32]) -> Tracks:
        """Give ids to new corners (N, 2) and append them to the live tracks; returns the new ones."""
        fresh = Tracks(np.arange(self.next_track_id, self.next_track_id + len(pixels)), pixels.astype(np.float32))
        self.next_track_id += len(pixels)
        self.tracks = self.tracks + fresh
        return fresh

    def add_corners(self, grey: NDArray[np.uint8], mask: Mask | None) -> None:
        """Begin tracks at new corners of a grey image where there are none and the mask is not zero."""
        self.new_tracks(find_corners(grey, self.tracks.pixels, self.config, mask))

    def move(
        self, stamp_ns: int, T_odom_cam: NDArray[np.float64], tracks: Tracks, reprojection_px: float | None = None
    ) -> None:
        """Take a new pose, the tracks seen from it, and the median error of those that agree with it."""
        if reprojection_px is not None and self.noise_px is not None:
            self.noise_px += NOISE_UPDATE * (reprojection_px - self.noise_px)
        elif reprojection_px is not None:
            self.noise_px = reprojection_px
        self.velocity = se3.inverse(self.T_odom_cam) @ T_odom_cam
        self.T_odom_cam = T_odom_cam
        self.tracks = tracks
        self.ages.step(tracks.ids)
        self.last_pose_stamp_ns = stamp_ns

    def observations(
        self, tracks: Tracks, inverse_depth: NDArray[np.float64], inverse_sigma: NDArray[np.float64]
    ) -> tuple[Observations, NDArray[np.bool_]]:
        """Return what tracks with a landmark say about the pose, and which tracks those are."""
        known, positions, spread = self.landmarks.known(tracks.ids)
        pixels = self.camera.undistort(tracks.pixels[known])
        inverse_depth = self.depth_offset.correct(inverse_depth[known])
        origin = self.reference.T_odom_cam[:3, 3]
        return Observations(positions, pixels, inverse_depth, inverse_sigma[known], spread, origin), known

    def gate_px(self) -> float:
        """Return how far a landmark may be seen from where it should be, by the noise of late: what moves slowly or
        along with the camera stays close.
        """
        limit = self.config.pnp_threshold_px
        if self.noise_px is None:
            return limit
        return float(np.clip(GATE_NOISES * self.noise_px, min(NARROWEST_GATE_PX, limit), limit))

    def prediction(self) -> Prediction:
        """Return where constant velocity puts the camera next, and how far that may be wrong."""
        step = float(np.linalg.norm(self.velocity[:3, 3]))
        uncertain = PREDICTION_SHARE * step + PREDICTION_OF_DEPTH * self.distance()
        return Prediction(self.T_odom_cam @ self.velocity, uncertain)

    def distance(self) -> float:
        """Return the median distance of what is tracked, 1 where none is known."""
        away = self.landmarks.known(self.tracks.ids)[1] - self.T_odom_cam[:3, 3]
        squared = np.einsum("ij,ij->i", away, away)
        middle = len(squared) // 2
        return float(np.sqrt(np.partition(squared, middle)[middle])) if len(squared) else 1.0

    def motion_since(self, T_odom_a: NDArray[np.float64], estimate: PoseEstimate | None) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the motion from ``T_odom_a`` to the present pose, which was estimated so."""
        return motion_covariance(
            T_odom_a,
            self.T_odom_cam,
            estimate,
            focal_px=self.camera.fx,
            depth=self.distance(),
            metric=self.metric,
        )

    def near_share(self) -> float:
        """Return the share of the tracked landmarks whose distance is known to better than a tenth."""
        spread = self.landmarks.spread(self.tracks.ids)
        known = int(np.isfinite(spread).sum())
        return float((spread < NEAR_SPREAD).sum()) / known if known else 0.0

    def revisit(self, image: Pyramid) -> None:
        """Take up landmarks of earlier keyframes that the current image shows again."""
        self.anchors = []
        live = self.landmarks.get(self.tracks.ids)
        live = live[np.isfinite(live[:, 0])]
        past = [*self.archive, *self.window[:-LIVE_KEYFRAMES]]
        if not past or len(live) == 0:
            return
        depth = float(np.median(se3.transform(se3.inverse(self.T_odom_cam), live)[:, 2]))
        for old in worth_revisiting(past, self.T_odom_cam, depth, self.config):
            positions = self.landmarks.get(old.track_ids)
            found = find_again(old, positions, image, self.T_odom_cam, self.camera, self.tracks, self.config)
            self.tracks = self.tracks + found
            if old.stamp_ns < self.window[0].stamp_ns and self._shares(old, self.tracks.ids):
                self.anchors.append(old)

    def _shares(self, old: WindowKeyframe, track_ids: NDArray[np.int64]) -> bool:
        """Return whether a keyframe sees enough of these landmarks to hold what sees them."""
        return int(np.isin(old.track_ids, track_ids).sum()) >= self.config.revisit_min_landmarks

    def _held_still(self) -> list[WindowKeyframe]:
        """Return the archived keyframes that hold the window: the anchors, and the newest that share its landmarks.

        What has left the window is not forgotten: without it, scale and heading would hang on the oldest pose alone.
        """
        if not self.archive:
            return []
        seen = np.concatenate([k.track_ids for k in self.window])
        sizes = [len(k.track_ids) for k in self.archive]
        again = np.isin(np.concatenate([k.track_ids for k in self.archive]), seen)
        shares = np.bincount(np.repeat(np.arange(len(sizes)), sizes), weights=again, minlength=len(sizes))
        anchored = {k.stamp_ns for k in self.anchors}
        others = [
            k
            for k, shared in zip(reversed(self.archive), shares[::-1], strict=True)
            if shared >= self.config.revisit_min_landmarks and k.stamp_ns not in anchored
        ]
        return [*self.anchors, *others[: self.config.covisible_keyframes]]

    def insert_keyframe(
        self,
        keyframe_id: int | None,
        stamp_ns: int,
        image: Pyramid,
        T_odom_cam: NDArray[np.float64],
        inverse_depth: NDArray[np.float64],
        inverse_sigma: NDArray[np.float64],
    ) -> None:
        """Add the live tracks, seen in an image, as a keyframe: new landmarks, then the window adjusted."""
        ids, seen = self.tracks.ids, self.tracks.pixels
        pixels = self.camera.undistort(seen)
        self.window.append(
            WindowKeyframe(keyframe_id, stamp_ns, T_odom_cam, image, ids, seen, pixels, inverse_depth, inverse_sigma)
        )
        if keyframe_id is not None:
            self.mapped = self.reference
        self._landmarks_from_parallax()
        while len(self.window) > self.config.window_keyframes:
            self.archive.append(self.window.pop(0))
        del self.archive[: max(0, len(self.archive) - self.config.archive_keyframes)]
        self.adjust_window()
        self._landmarks_from_depth()  # after the adjustment: they hang on this keyframe's pose alone
        self._landmarks_presumed()
        self.T_odom_cam = self.reference.T_odom_cam
        self.n_at_keyframe = int(np.isfinite(self.landmarks.get(self.tracks.ids)[:, 0]).sum())
        self.landmarks.retain(np.concatenate([k.track_ids for k in (*self.window, *self.archive)]))

    def _landmarks_from_depth(self) -> None:
        newest = self.reference
        missing = np.isnan(self.landmarks.get(newest.track_ids)[:, 0])
        spread = newest.inverse_sigma / newest.inverse_depth
        with np.errstate(invalid="ignore"):
            usable = missing & (spread < SPREAD)
        pixels = newest.pixels[usable]
        inverse = self.depth_offset.correct(newest.inverse_depth[usable])
        positions = se3.transform(newest.T_odom_cam, normalised_rays(pixels, self.camera) / inverse[:, None])
        self.landmarks.set(newest.track_ids[usable], positions, spread[usable])

    def _landmarks_presumed(self) -> None:
        """Give the tracks that nothing is known of the distance of what is seen beside them.

        They hold the rotation where a camera turns faster than it moves, until parallax tells more.
        """
        newest = self.reference
        positions = self.landmarks.get(newest.track_ids)
        missing = np.isnan(positions[:, 0])
        known = ~missing & (self.landmarks.spread(newest.track_ids) < TRIANGULATED_SPREAD)
        depths = se3.transform(se3.inverse(newest.T_odom_cam), positions[known])[:, 2]
        presumed = presume(newest.pixels[missing], newest.pixels[known], depths)
        if presumed is None:
            return
        rays = normalised_rays(newest.pixels[missing], self.camera)
        positions = se3.transform(newest.T_odom_cam, rays * presumed[:, None])
        self.landmarks.set(newest.track_ids[missing], positions, np.full(len(positions), SPREAD))
        if self.metric:  # a weak reading among firm ones; in mono, where there are no others, it would bend the scale
            inverse, sigma = newest.inverse_depth.copy(), newest.inverse_sigma.copy()
            inverse[missing], sigma[missing] = 1 / presumed, SPREAD / presumed
            self.window[-1] = replace(newest, inverse_depth=inverse, inverse_sigma=sigma)

    def _landmarks_from_parallax(self) -> None:
        newest = self.reference
        todo = ~(self.landmarks.spread(newest.track_ids) < TRIANGULATED_SPREAD)
        todo |= np.isnan(self.landmarks.get(newest.track_ids)[:, 0])
        c = self.config
        rows, points, angle = triangulate_tracks(
            newest,
            self.window[:-1],
            todo,
            self.camera,
            min_angle_rad=np.deg2rad(c.triangulation_min_angle_deg),
            threshold_px=c.pnp_threshold_px,
        )
        self.landmarks.set(newest.track_ids[rows], points, c.pixel_sigma / (self.camera.fx * np.maximum(angle, 1e-6)))

    def adjust_window(self) -> None:
        """Bundle-adjust the window and forget landmarks that do not fit; keyframes held still and the oldest poses
        hold the gauge.
        """
        n_fixed = 1 if self.metric or len(self.window) == 2 else 2
        if len(self.window) <= n_fixed:
            return
        still = self._held_still()
        views, c = [*still, *self.window], self.config
        problem, track_ids = bundle_of(views, len(still) + n_fixed, self.landmarks, self.depth_offset)
        if len(track_ids) < c.min_inliers:
            return
        result = adjust(problem, self.camera, pixel_sigma=c.pixel_sigma, iterations=c.window_iterations)
        if not (np.isfinite(result.poses).all() and np.isfinite(result.landmarks).all()):
            return
        starts = np.flatnonzero(np.diff(problem.landmark_of, prepend=-1))
        worst = np.maximum.reduceat(result.errors_px, starts)
        positions = np.where((worst < OUTLIER_PX)[:, None], result.landmarks, np.nan)
        along = result.landmarks - result.poses[-1][:3, 3]
        variance = np.einsum("li,lij,lj->l", along, result.landmark_covariances, along)
        spread = np.sqrt(np.maximum(variance, 0)) / np.maximum((along * along).sum(axis=1), 1e-12)
        self.landmarks.set(track_ids, positions, spread)
        self.tracks = self.tracks[~np.isin(self.tracks.ids, track_ids[worst >= OUTLIER_PX])]
        adjusted = result.poses[len(still) :]
        self.window = [replace(k, T_odom_cam=T) for k, T in zip(self.window, adjusted, strict=True)]
        # each observation is in as many windows as there are keyframes in one
        self.mapped = next((k for k in self.window if self.mapped and k.id == self.mapped.id), self.mapped)
        information = result.depth_information / c.window_keyframes
        self.depth_offset = self.depth_offset.learned(result.depth_offset, information)
