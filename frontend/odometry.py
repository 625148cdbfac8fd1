"""The front end as one step per frame: refuse, track, estimate, decide, update."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3, tracker
from seamark.frontend.admission import StampGate, refusal
from seamark.frontend.camera import CalibrationError
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import NoDepth, make_depth_sensor
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.features import grey_of
from seamark.frontend.keyframes import KeyframeBuilder
from seamark.frontend.loss import MIN_CORNERS, loss_of
from seamark.frontend.masks import allowed, combined, read_mask
from seamark.frontend.monocular import MonoInitialiser, insert_first_keyframes
from seamark.frontend.motion_mask import MotionMasks
from seamark.frontend.pose import PoseEstimate
from seamark.frontend.pyramid import Pyramid, pyramid_of
from seamark.frontend.recovery import recover
from seamark.frontend.session import Session
from seamark.frontend.stopwatch import Stopwatch
from seamark.frontend.tracks import Tracks
from seamark.frontend.types import Frame, Keyframe, Mode, Odometry, Outcome, Quality, Rig


@dataclass(frozen=True, eq=False)
class FrontendResult:
    """What one step gives: the odometry of its frame, and keyframes whose content has become ready."""

    odometry: Odometry
    keyframes: tuple[Keyframe, ...]


class Frontend:
    """Visual odometry and keyframes of one camera.

    One code path serves mono, stereo and RGB-D; they differ in the depth sensor. Mode ``PLACES`` makes every frame a
    keyframe without a pose; there a calibration holds for images of its size, others are taken as without. Raises
    CalibrationError when the mode needs what the rig does not have, MaskError for a bad mask file. ``clock`` (seconds)
    measures stages for the report and decides nothing.
    """

    def __init__(
        self, rig: Rig | None, mode: Mode, config: FrontendConfig, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        if mode is not Mode.PLACES and rig is None:
            raise CalibrationError(f"mode {mode} needs a calibration")
        self._rig, self._mode, self._config, self._clock = rig, mode, config, clock
        self._sensor = make_depth_sensor(rig, mode, config) if rig is not None else NoDepth()
        self._depth_offset = DepthOffset.expected(self._sensor.systematic_sigma)
        self._builder = KeyframeBuilder(rig, mode, config, self._sensor)
        self._session: Session | None = None
        self._initialiser: MonoInitialiser | None = None
        self._image: Pyramid | None = None
        self._stamps = StampGate(mode, config)
        camera = rig.cam0 if rig is not None and mode is not Mode.PLACES else None
        self._mask = read_mask(config.mask_file, camera) if config.mask_file is not None else None
        self._motion: MotionMasks | None = None
        self._next_session = 0
        self._T_odom_start = se3.T_WORLD_LEVEL_CAM.copy()

    def step(self, frame: Frame) -> FrontendResult:
        """Process one frame; frames come in the order of their stamps."""
        refused = refusal(frame, self._rig, self._mode) or self._stamps.admit(frame.stamp_ns)
        if self._mask is not None and self._mask.shape == frame.image.shape[:2]:
            frame = replace(frame, mask=combined(self._mask, frame.mask))
        if refused is not None and refused is not Outcome.CLOCK_RESET:
            odometry = report(frame, refused, Quality.LOST)
        elif self._mode is Mode.PLACES:
            odometry = self._place(frame)
        elif refused is Outcome.CLOCK_RESET:
            self._end_session()
            odometry = replace(self._follow(frame), outcome=Outcome.CLOCK_RESET)
        else:
            with self._builder.tracking():
                odometry = self._follow(frame)
        return FrontendResult(odometry, self._builder.take())

    def finish(self) -> tuple[Keyframe, ...]:
        """Wait for the keyframes whose content is still being made and return them."""
        self._builder.wait()
        return self._builder.take()

    def close(self) -> None:
        """Stop the keyframe thread."""
        self._builder.close()

    def _place(self, frame: Frame) -> Odometry:
        request = self._builder.request(frame, session=0)
        self._builder.submit([request])
        return report(frame, Outcome.PLACE, Quality.GOOD, session=0, keyframe_id=request.id)

    def _follow(self, frame: Frame) -> Odometry:
        """Say where the camera of one frame is."""
        watch = Stopwatch(self._clock)
        image = pyramid_of(grey_of(frame.image), self._config.flow_levels)
        session, before, self._image = self._session, self._image, image
        if session is None or before is None:
            return self._start(frame, image)

        tracks, was = tracker.follow(session, before, image, predict=self._initialiser is None)
        usable = allowed(frame.mask, tracks.pixels)
        tracks, was = tracks[usable], was[usable]
        watch.lap("track")
        if self._initialiser is not None:
            return self._initialise(session, self._initialiser, frame, image, tracks)

        readings, prediction = tracker.readings(self._sensor, frame, tracks), session.prediction()
        pose, keep = tracker.estimate(session, tracks, readings, prediction)
        watch.lap("pose")
        if pose is None or tracker.abrupt(session, pose):
            recovered = self._recover(session, frame, image, pose)
            if recovered is not None:
                return recovered
        if pose is None:
            return self._lose(session, frame, image)
        settled = tracker.settle(session, image, tracks, pose.T_odom_cam)
        better, keep_better = tracker.estimate(session, settled, readings, prediction, pose)
        if better is not None:
            pose, keep, tracks = better, keep_better, settled
        watch.lap("settle")

        session.move(frame.stamp_ns, pose.T_odom_cam, tracks[keep], pose.reprojection_px)
        ages = session.ages.of(session.tracks.ids)
        moving = (
            self._motion.step(image.grey, frame.stamp_ns, pose.T_odom_cam, session.distance()) if self._motion else None
        )
        keyframe_id = None
        if tracker.keyframe_due(session, frame.stamp_ns, int(pose.inliers.sum())):
            keyframe_id = self._insert_keyframe(session, frame, image, pose)
            watch.lap("keyframe")
        arrows = np.hstack([tracks.pixels, was])[keep]
        odometry = self._tracked(session, frame, pose, Outcome.TRACKED, keyframe_id, arrows, watch.stages_ms)
        return replace(odometry, track_ages=ages, motion_mask=moving)

    def _insert_keyframe(
        self, session: Session, frame: Frame, image: Pyramid, estimate: PoseEstimate | None
    ) -> int | None:
        """Make the current frame a keyframe: new corners and depths, the window adjusted, its content under way.

        Returns its id, or None where it serves the window only and the map is spared one more of the same.
        """
        previous = session.mapped
        keyframe_id = self._builder.next_id if tracker.map_keyframe_due(session, frame.stamp_ns) else None
        session.revisit(image)
        session.add_corners(image.grey, frame.mask)
        depths = self._sensor.inverse_depth(frame, session.tracks.pixels)
        session.insert_keyframe(keyframe_id, frame.stamp_ns, image, session.T_odom_cam, *depths)
        if keyframe_id is None:
            return None
        motion = None
        if previous is not None and estimate is not None:
            motion = session.motion_since(previous.T_odom_cam, estimate)
        request = self._builder.request(
            frame, session.id, previous.id if previous else None, session.T_odom_cam, motion, session.depth_offset
        )
        self._builder.submit([request])
        return request.id

    def _start(self, frame: Frame, image: Pyramid) -> Odometry:
        """Begin a session where there is enough to see; its odometry goes on from where the last one ended."""
        assert self._rig is not None
        mono = self._mode is Mode.MONO
        session = Session(
            self._next_session, self._config, self._rig.cam0, not mono, self._T_odom_start, self._depth_offset
        )
        session.add_corners(image.grey, frame.mask)
        inverse, _ = self._sensor.inverse_depth(frame, session.tracks.pixels)
        usable = len(session.tracks) if mono else int(np.isfinite(inverse).sum())
        if usable < MIN_CORNERS:
            self._session = None
            return report(frame, Outcome.LOST, Quality.LOST, loss=loss_of(image.grey, self._config.min_corner_response))
        self._session = session
        self._motion = MotionMasks(self._rig.cam0.fx) if self._config.motion_masks else None
        session.last_pose_stamp_ns = frame.stamp_ns
        self._next_session += 1
        if mono:
            return self._begin_initialising(session, frame)
        keyframe_id = self._insert_keyframe(session, frame, image, None)
        return report(
            frame,
            Outcome.NEW_SESSION,
            Quality.GOOD,
            session=session.id,
            inliers=session.n_at_keyframe,
            T_odom_cam=session.T_odom_cam,
            reference_id=keyframe_id,
            T_reference_cam=np.eye(4),
            keyframe_id=keyframe_id,
        )

    def _begin_initialising(self, session: Session, frame: Frame) -> Odometry:
        self._initialiser = MonoInitialiser(frame, session.camera, self._config)
        self._initialiser.add(frame, session.tracks)
        return report(frame, Outcome.INITIALISING, Quality.LOST, session=session.id)

    def _initialise(
        self, session: Session, initialiser: MonoInitialiser, frame: Frame, image: Pyramid, tracks: Tracks
    ) -> Odometry:
        """Wait for enough parallax, then make the first two mono keyframes and fill in the frames between."""
        session.tracks = tracks
        initialiser.add(frame, tracks)
        result = initialiser.attempt()
        if result is None:
            if not initialiser.exhausted:
                return report(frame, Outcome.INITIALISING, Quality.LOST, session=session.id)
            session.tracks = Tracks.none()
            session.add_corners(image.grey, frame.mask)
            return self._begin_initialising(session, frame)

        two_view, ids = result
        self._initialiser = None
        filled = insert_first_keyframes(session, initialiser, frame, image, two_view, ids, self._builder)
        return report(
            frame,
            Outcome.TRACKED,
            Quality.GOOD,
            session=session.id,
            inliers=int(np.isfinite(two_view.landmarks[:, 0]).sum()),
            T_odom_cam=session.T_odom_cam,
            reference_id=session.reference.id,
            T_reference_cam=np.eye(4),
            keyframe_id=session.reference.id,
            filled=filled,
        )

    def _recover(self, session: Session, frame: Frame, image: Pyramid, by_flow: PoseEstimate | None) -> Odometry | None:
        """Flow has failed, or holds little: descriptors against recent keyframes, None where they hold no more."""
        found = recover(frame, self._builder.recent(session.id), session.camera, self._config, session.prediction())
        if found is None or (by_flow is not None and found.estimate.inliers.sum() <= by_flow.inliers.sum()):
            return None
        session.tracks = Tracks.none()
        fresh = session.new_tracks(found.pixels)
        session.landmarks.set(fresh.ids, found.landmarks, found.spread)
        session.move(frame.stamp_ns, found.estimate.T_odom_cam, session.tracks)
        session.velocity = np.eye(4)
        keyframe_id = self._insert_keyframe(session, frame, image, found.estimate)
        arrows = np.hstack([found.pixels, found.pixels])
        return self._tracked(session, frame, found.estimate, Outcome.RECOVERED, keyframe_id, arrows, {})

    def _lose(self, session: Session, frame: Frame, image: Pyramid) -> Odometry:
        """Nothing known is found: lost, and after a while a new session."""
        session.tracks = Tracks.none()
        session.velocity = np.eye(4)
        if frame.stamp_ns - session.last_pose_stamp_ns < 1e9 * self._config.patience_s:
            loss = loss_of(image.grey, self._config.min_corner_response)
            return report(frame, Outcome.LOST, Quality.LOST, session=session.id, loss=loss)
        self._end_session()
        return self._start(frame, image)

    def _end_session(self) -> None:
        """Leave the session; odometry of the next one goes on from where this one was."""
        if self._session is not None:
            self._T_odom_start, self._depth_offset = self._session.T_odom_cam, self._session.depth_offset
        self._session = self._initialiser = None

    def _tracked(
        self,
        session: Session,
        frame: Frame,
        pose: PoseEstimate,
        outcome: Outcome,
        keyframe_id: int | None,
        arrows: NDArray[np.float32],
        stages_ms: dict[str, float],
    ) -> Odometry:
        inliers, reference = int(pose.inliers.sum()), session.mapped
        assert reference is not None, "the first keyframe of a session is one of the map"
        return report(
            frame,
            outcome,
            Quality.GOOD if inliers >= self._config.good_inliers else Quality.MARGINAL,
            session=session.id,
            inliers=inliers,
            reprojection_px=pose.reprojection_px,
            T_odom_cam=session.T_odom_cam,
            reference_id=reference.id,
            T_reference_cam=se3.inverse(reference.T_odom_cam) @ session.T_odom_cam,
            covariance=session.motion_since(reference.T_odom_cam, pose),
            keyframe_id=keyframe_id,
            tracks=arrows,
            stages_ms=stages_ms,
            near_share=session.near_share(),
        )


def report(frame: Frame, outcome: Outcome, quality: Quality, *, session: int = -1, **known: object) -> Odometry:
    """Return the odometry of a frame with the fields that are known."""
    return Odometry(frame.index, frame.stamp_ns, frame.file, session, quality, outcome, **known)  # type: ignore[arg-type]
