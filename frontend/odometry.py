"""The front end as one step per frame: predict, track, estimate, decide, update."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import flow, se3
from seamark.frontend.camera import CalibrationError
from seamark.frontend.config import FrontendConfig
from seamark.frontend.corners import detect_corners
from seamark.frontend.depth import DepthImage, NoDepth, make_depth_sensor
from seamark.frontend.features import grey_of
from seamark.frontend.keyframes import KeyframeBuilder, KeyframeRequest
from seamark.frontend.monocular import MonoInitialiser
from seamark.frontend.pose import PoseEstimate, estimate_pose, motion_covariance
from seamark.frontend.recovery import recover
from seamark.frontend.session import Session, Tracks
from seamark.frontend.two_view import rotation_compensated_parallax
from seamark.frontend.types import Filled, Frame, Keyframe, Mode, Odometry, Outcome, Quality, Rig

GUESS_DEPTH = 1e3  # tracks without a landmark move as if far away: by the rotation only
RETRY_SURVIVORS = 0.5
MIN_CORNERS = 40  # a session needs something to see
STILL_PX = 1.0


@dataclass(frozen=True, eq=False)
class FrontendResult:
    """What one step gives: the odometry of its frame, and keyframes whose content has become ready."""

    odometry: Odometry
    keyframes: tuple[Keyframe, ...]


class Stopwatch:
    """Collects the milliseconds of named stages; times are reported, never decided upon."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._last = clock, clock()
        self.stages_ms: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Book the time since the last lap."""
        now = self._clock()
        self.stages_ms[stage] = self.stages_ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


class Frontend:
    """Visual odometry and keyframes of one camera.

    One code path serves mono, stereo and RGB-D; they differ in the depth sensor. Mode ``PLACES`` makes every frame a
    keyframe without a pose. Raises CalibrationError when the mode needs what the rig does not have.
    """

    def __init__(
        self, rig: Rig | None, mode: Mode, config: FrontendConfig, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        if mode is not Mode.PLACES and rig is None:
            raise CalibrationError(f"mode {mode} needs a calibration")
        if mode is Mode.STEREO and (rig is None or rig.cam1 is None):
            raise CalibrationError("mode stereo needs a calibration of both cameras")
        self._rig, self._mode, self._config, self._clock = rig, mode, config, clock
        self._sensor = make_depth_sensor(rig, mode, config) if rig is not None else NoDepth()
        self._builder = KeyframeBuilder(rig, mode, config, self._sensor)
        self._session: Session | None = None
        self._initialiser: MonoInitialiser | None = None
        self._grey: NDArray[np.uint8] | None = None
        self._last_stamp_ns: int | None = None
        self._next_session = 0
        self._next_keyframe = 0
        self._ready: list[Keyframe] = []
        self._T_odom_start = se3.T_WORLD_LEVEL_CAM.copy()

    def step(self, frame: Frame) -> FrontendResult:
        """Process one frame; frames come in the order of their stamps."""
        watch = Stopwatch(self._clock)
        refusal = self._refuse(frame)
        if refusal is not None:
            odometry = self._odometry(frame, refusal, Quality.LOST)
        elif self._mode is Mode.PLACES:
            odometry = self._place(frame)
        else:
            odometry = self._follow(frame, watch)
        self._ready += self._builder.finished()
        ready, self._ready = tuple(self._ready), []
        return FrontendResult(odometry, ready)

    def finish(self) -> tuple[Keyframe, ...]:
        """Wait for the keyframes whose content is still being made and return them."""
        ready, self._ready = (*self._ready, *self._builder.wait()), []
        return ready

    def close(self) -> None:
        """Stop the keyframe thread."""
        self._builder.close()

    # --- one frame ------------------------------------------------------------------------------------------------

    def _refuse(self, frame: Frame) -> Outcome | None:
        """Return why a frame cannot be used, or None and take its stamp as the newest."""
        if self._rig is not None and frame.image.shape[:2] != (self._rig.cam0.height, self._rig.cam0.width):
            return Outcome.WRONG_SIZE
        last = self._last_stamp_ns
        if last is not None and frame.stamp_ns <= last:
            return Outcome.REPEATED_STAMP if frame.stamp_ns == last else Outcome.STAMP_BACKWARD
        self._last_stamp_ns = frame.stamp_ns
        return None

    def _place(self, frame: Frame) -> Odometry:
        keyframe_id = self._submit(frame, session=0, previous_id=None, T=None, covariance=None)
        return self._odometry(frame, Outcome.PLACE, Quality.GOOD, session=0, keyframe_id=keyframe_id)

    def _follow(self, frame: Frame, watch: Stopwatch) -> Odometry:
        grey = grey_of(frame.image)
        session, before, self._grey = self._session, self._grey, grey
        if session is None or before is None:
            return self._start(frame, grey)

        tracks, was = self._track(session, before, grey)
        watch.lap("track")
        if self._initialiser is not None:
            return self._initialise(session, self._initialiser, frame, grey, tracks)

        estimate, tracks, was = self._estimate(session, frame, tracks, was)
        watch.lap("pose")
        if estimate is None:
            return self._recover(session, frame, grey)

        self._advance(session, frame, estimate.T_odom_cam, tracks)
        keyframe_id = None
        if self._keyframe_due(session, frame, estimate):
            keyframe_id = self._insert_keyframe(session, frame, grey, estimate.covariance)
            watch.lap("keyframe")
        return self._tracked(session, frame, estimate, Outcome.TRACKED, keyframe_id, np.hstack([tracks.pixels, was]), watch)

    def _track(
        self, session: Session, before: NDArray[np.uint8], after: NDArray[np.uint8]
    ) -> tuple[Tracks, NDArray[np.float32]]:
        """Follow the live tracks into the new image; returns the survivors and where they were."""
        c, tracks = self._config, session.tracks
        guess = self._guess(session, tracks) if self._initialiser is None else None
        settings = {"window_px": c.flow_window_px, "levels": c.flow_levels, "round_trip_px": c.flow_round_trip_px}
        there, ok = flow.track(before, after, tracks.pixels, guess, **settings)  # type: ignore[arg-type]
        if guess is not None and ok.mean() < RETRY_SURVIVORS:
            again, ok_again = flow.track(before, after, tracks.pixels, None, **settings)  # type: ignore[arg-type]
            if ok_again.sum() > ok.sum():
                there, ok = again, ok_again
        return Tracks(tracks.ids[ok], there[ok]), tracks.pixels[ok]

    def _guess(self, session: Session, tracks: Tracks) -> NDArray[np.float32]:
        """Predict pixels by constant velocity; tracks without a landmark turn with the camera."""
        T_predicted = session.T_odom_cam @ session.velocity
        positions = session.landmarks.get(tracks.ids)
        unknown = np.isnan(positions[:, 0])
        far = session.camera.rays(tracks.pixels[unknown]) * GUESS_DEPTH
        positions[unknown] = se3.transform(session.T_odom_cam, far)
        in_cam = se3.transform(se3.inverse(T_predicted), positions)
        visible = in_cam[:, 2] > 0.05
        guess = tracks.pixels.copy()
        guess[visible] = session.camera.project(in_cam[visible])
        size = np.array([session.camera.width, session.camera.height])
        outside = ((guess < 0) | (guess > size - 1)).any(axis=1)
        guess[outside] = tracks.pixels[outside]
        return guess

    def _estimate(
        self, session: Session, frame: Frame, tracks: Tracks, was: NDArray[np.float32]
    ) -> tuple[PoseEstimate | None, Tracks, NDArray[np.float32]]:
        """Estimate the pose from tracks with landmarks; outliers among them end as tracks."""
        c = self._config
        if isinstance(self._sensor, DepthImage):
            inverse, sigma = self._sensor.inverse_depth(frame, tracks.pixels)
        else:
            inverse = sigma = np.full(len(tracks), np.nan)
        observations, known = session.observations(tracks, inverse, sigma)
        estimate = estimate_pose(
            observations,
            session.camera,
            threshold_px=c.pnp_threshold_px,
            iterations=c.pnp_iterations,
            pixel_sigma=c.pixel_sigma,
            minimum=c.min_inliers,
        )
        if estimate is None:
            return None, tracks, was
        keep = np.ones(len(tracks), bool)
        keep[np.flatnonzero(known)[~estimate.inliers]] = False
        return estimate, tracks[keep], was[keep]

    def _advance(self, session: Session, frame: Frame, T_odom_cam: NDArray[np.float64], tracks: Tracks) -> None:
        session.velocity = se3.inverse(session.T_odom_cam) @ T_odom_cam
        session.T_odom_cam = T_odom_cam
        session.tracks = tracks
        session.last_pose_stamp_ns = frame.stamp_ns

    # --- keyframes ------------------------------------------------------------------------------------------------

    def _keyframe_due(self, session: Session, frame: Frame, estimate: PoseEstimate) -> bool:
        """Decide by what is still seen, parallax, rotation and time; never by a clock other than the sensor's."""
        c, reference = self._config, session.reference
        if estimate.inliers.sum() < max(c.good_inliers, c.keyframe_tracked_ratio * session.n_at_keyframe):
            return True
        T_reference_cam = se3.inverse(reference.T_odom_cam) @ session.T_odom_cam
        if float(se3.rotation_angle(T_reference_cam[:3, :3])) > np.deg2rad(c.keyframe_rotation_deg):
            return True
        _, i, j = np.intersect1d(reference.track_ids, session.tracks.ids, assume_unique=True, return_indices=True)
        if len(i) == 0:
            return True
        rays = session.camera.rays(session.tracks.pixels[j])
        parallax = float(
            np.median(rotation_compensated_parallax(T_reference_cam[:3, :3], reference.pixels[i], rays, session.camera))
        )
        waited_s = 1e-9 * (frame.stamp_ns - reference.stamp_ns)
        return parallax > c.keyframe_parallax_px or (waited_s > c.keyframe_max_gap_s and parallax > STILL_PX)

    def _insert_keyframe(
        self, session: Session, frame: Frame, grey: NDArray[np.uint8], covariance: NDArray[np.float64]
    ) -> int:
        previous = session.window[-1] if session.window else None
        self._new_corners(session, grey)
        inverse, sigma = self._sensor.inverse_depth(frame, session.tracks.pixels)
        keyframe_id = self._next_keyframe
        T_before = session.T_odom_cam
        session.insert_keyframe(keyframe_id, frame.stamp_ns, T_before, inverse, sigma)
        self._submit(
            frame,
            session=session.id,
            previous_id=previous.id if previous else None,
            T=session.T_odom_cam,
            covariance=motion_covariance(previous.T_odom_cam, session.T_odom_cam, covariance) if previous else None,
        )
        return keyframe_id

    def _new_corners(self, session: Session, grey: NDArray[np.uint8]) -> None:
        c = self._config
        corners = detect_corners(
            grey,
            session.tracks.pixels,
            c.max_corners,
            harris=c.corner_detector == "harris",
            min_response=c.min_corner_response,
        )
        session.new_tracks(corners)

    def _request(
        self, frame: Frame, *, session: int, previous_id: int | None, T: NDArray[np.float64] | None,
        covariance: NDArray[np.float64] | None,
    ) -> KeyframeRequest:
        request = KeyframeRequest(frame, self._next_keyframe, session, previous_id, T, covariance)
        self._next_keyframe += 1
        return request

    def _submit(
        self, frame: Frame, *, session: int, previous_id: int | None, T: NDArray[np.float64] | None,
        covariance: NDArray[np.float64] | None,
    ) -> int:
        request = self._request(frame, session=session, previous_id=previous_id, T=T, covariance=covariance)
        self._builder.submit([request])
        return request.id

    # --- beginnings and endings -------------------------------------------------------------------------------------

    def _start(self, frame: Frame, grey: NDArray[np.uint8]) -> Odometry:
        """Begin a session where there is enough to see; its odometry goes on from where the last one ended."""
        assert self._rig is not None
        session = Session(
            self._next_session, self._config, self._rig.cam0, self._mode is not Mode.MONO, self._T_odom_start
        )
        self._new_corners(session, grey)
        inverse, _ = self._sensor.inverse_depth(frame, session.tracks.pixels)
        enough = MIN_CORNERS if self._mode is Mode.MONO else self._config.good_inliers
        usable = len(session.tracks) if self._mode is Mode.MONO else int(np.isfinite(inverse).sum())
        if usable < enough:
            self._session = None
            return self._odometry(frame, Outcome.LOST, Quality.LOST)
        self._session = session
        session.last_pose_stamp_ns = frame.stamp_ns
        self._next_session += 1
        if self._mode is Mode.MONO:
            self._initialiser = MonoInitialiser(frame, session.camera, self._config)
            self._initialiser.add(frame, session.tracks)
            return self._odometry(frame, Outcome.INITIALISING, Quality.LOST, session=session.id)
        keyframe_id = self._insert_keyframe(session, frame, grey, np.eye(6))
        return self._odometry(
            frame,
            Outcome.NEW_SESSION,
            Quality.GOOD,
            session=session.id,
            inliers=session.n_at_keyframe,
            reprojection_px=0.0,
            T_odom_cam=session.T_odom_cam,
            reference_id=keyframe_id,
            T_reference_cam=np.eye(4),
            keyframe_id=keyframe_id,
        )

    def _initialise(
        self, session: Session, initialiser: MonoInitialiser, frame: Frame, grey: NDArray[np.uint8], tracks: Tracks
    ) -> Odometry:
        """Wait for enough parallax, then make the first two mono keyframes and fill in the frames between."""
        session.tracks = tracks
        initialiser.add(frame, tracks)
        result = initialiser.attempt()
        if result is None:
            if initialiser.exhausted:
                session.tracks = Tracks.none()
                self._new_corners(session, grey)
                self._initialiser = MonoInitialiser(frame, session.camera, self._config)
                self._initialiser.add(frame, session.tracks)
            return self._odometry(frame, Outcome.INITIALISING, Quality.LOST, session=session.id)

        two_view, ids = result
        self._initialiser = None
        T_odom_first = session.T_odom_cam
        session.landmarks.set(ids, se3.transform(T_odom_first, two_view.landmarks))
        filled, covariance = self._first_keyframes(session, initialiser, frame, grey, T_odom_first @ two_view.T_first_second)
        session.velocity = np.eye(4)
        session.last_pose_stamp_ns = frame.stamp_ns
        reference = session.reference
        return self._odometry(
            frame,
            Outcome.TRACKED,
            Quality.GOOD,
            session=session.id,
            inliers=int(np.isfinite(two_view.landmarks[:, 0]).sum()),
            reprojection_px=0.0,
            T_odom_cam=session.T_odom_cam,
            reference_id=reference.id,
            T_reference_cam=np.eye(4),
            covariance=covariance,
            keyframe_id=reference.id,
            filled=filled,
        )

    def _first_keyframes(
        self, session: Session, initialiser: MonoInitialiser, frame: Frame, grey: NDArray[np.uint8],
        T_odom_second: NDArray[np.float64],
    ) -> tuple[tuple[Filled, ...], NDArray[np.float64]]:
        """Insert the first and the newest view as keyframes; returns the poses of the views between."""
        first, T_odom_first = initialiser.views[0], session.T_odom_cam
        live = session.tracks
        keep = np.isin(first.tracks.ids, live.ids)
        unknown = np.full(int(keep.sum()), np.nan)
        a = self._request(initialiser.first, session=session.id, previous_id=None, T=T_odom_first, covariance=None)
        session.tracks = first.tracks[keep]
        session.insert_keyframe(a.id, first.stamp_ns, T_odom_first, unknown, unknown)
        session.tracks = live
        self._new_corners(session, grey)
        unknown = np.full(len(session.tracks), np.nan)
        session.insert_keyframe(self._next_keyframe, frame.stamp_ns, T_odom_second, unknown, unknown)
        covariance = motion_covariance(T_odom_first, session.T_odom_cam, 1e-6 * np.eye(6))
        b = self._request(frame, session=session.id, previous_id=a.id, T=session.T_odom_cam, covariance=covariance)
        self._builder.submit([a, b])
        positions = session.landmarks.get(live.ids)
        known = np.flatnonzero(np.isfinite(positions[:, 0]))
        rows = {int(live.ids[k]): int(k) for k in known}
        filled = initialiser.fill(session.id, a.id, T_odom_first, rows, positions)
        return (Filled(first.index, first.stamp_ns, session.id, a.id, np.eye(4)), *filled), covariance

    def _recover(self, session: Session, frame: Frame, grey: NDArray[np.uint8]) -> Odometry:
        """Flow has failed: descriptors against recent keyframes, else lost, after a while a new session."""
        self._ready += self._builder.wait()
        recent = [k for k in self._builder.recent if k.session == session.id]
        recovered = recover(frame, recent, session.camera, self._config)
        if recovered is not None:
            session.tracks = Tracks.none()
            fresh = session.new_tracks(recovered.pixels)
            session.landmarks.set(fresh.ids, recovered.landmarks)
            self._advance(session, frame, recovered.estimate.T_odom_cam, session.tracks)
            session.velocity = np.eye(4)
            keyframe_id = self._insert_keyframe(session, frame, grey, recovered.estimate.covariance)
            arrows = np.hstack([recovered.pixels, recovered.pixels])
            return self._tracked(session, frame, recovered.estimate, Outcome.RECOVERED, keyframe_id, arrows, None)
        session.tracks = Tracks.none()
        if frame.stamp_ns - session.last_pose_stamp_ns < 1e9 * self._config.patience_s:
            return self._odometry(frame, Outcome.LOST, Quality.LOST, session=session.id)
        self._T_odom_start = session.T_odom_cam
        self._session = None
        return self._start(frame, grey)

    # --- results ----------------------------------------------------------------------------------------------------

    def _tracked(
        self, session: Session, frame: Frame, estimate: PoseEstimate, outcome: Outcome, keyframe_id: int | None,
        tracks: NDArray[np.float32], watch: Stopwatch | None,
    ) -> Odometry:
        inliers = int(estimate.inliers.sum())
        T_reference_cam = se3.inverse(session.reference.T_odom_cam) @ session.T_odom_cam
        return self._odometry(
            frame,
            outcome,
            Quality.GOOD if inliers >= self._config.good_inliers else Quality.MARGINAL,
            session=session.id,
            inliers=inliers,
            reprojection_px=estimate.reprojection_px,
            T_odom_cam=session.T_odom_cam,
            reference_id=session.reference.id,
            T_reference_cam=T_reference_cam,
            covariance=motion_covariance(session.reference.T_odom_cam, session.T_odom_cam, estimate.covariance),
            keyframe_id=keyframe_id,
            tracks=tracks,
            stages_ms=watch.stages_ms if watch else {},
        )

    @staticmethod
    def _odometry(frame: Frame, outcome: Outcome, quality: Quality, *, session: int = -1, **known: object) -> Odometry:
        return Odometry(frame.index, frame.stamp_ns, frame.file, session, quality, outcome, **known)  # type: ignore[arg-type]
