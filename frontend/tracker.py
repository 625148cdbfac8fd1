"""The parts of a tracking step: predict where tracks go, follow them, estimate the pose, decide about a keyframe."""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import flow, se3
from seamark.frontend.camera import Camera
from seamark.frontend.depth import DepthImage, DepthSensor
from seamark.frontend.patches import align_warped
from seamark.frontend.pose import PoseEstimate, Prediction, estimate_pose
from seamark.frontend.pyramid import Pyramid, pyramid_of
from seamark.frontend.session import Session
from seamark.frontend.static_votes import static_votes
from seamark.frontend.tone import match_tone
from seamark.frontend.tracks import Tracks, shared
from seamark.frontend.two_view import rotation_compensated_parallax
from seamark.frontend.types import Frame
from seamark.frontend.window import WindowKeyframe

GUESS_DEPTH = 1e3  # tracks without a landmark move as if far away: by the rotation only
RETRY_SURVIVORS = 0.5
STILL_PX = 1.0
ABRUPT_SHARE = 0.25
PATCH_PX = 5.0
MIN_DEPTH = 1e-3
MAX_LOG_SCALE = 1.1  # a patch that has grown or shrunk threefold in area is another one
MIN_CORRELATION = 0.8
MAX_SETTLING_PX = 1.5
MAJORITY = 0.5  # of the votes; where fewer agree within the noise of late, the noise may have grown


def predict_pixels(session: Session, tracks: Tracks) -> NDArray[np.float32]:
    """Predict where tracks (N) will be seen, (N, 2), by constant velocity; unknown depths turn with the camera."""
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


def follow(session: Session, before: Pyramid, after: Pyramid, *, predict: bool) -> tuple[Tracks, NDArray[np.float32]]:
    """Follow the live tracks into the next image; returns the survivors and where they were (N, 2).

    Where half of the tracks are lost, the prediction was wrong, or the exposure has changed: they are then searched
    from where they were, and in the tone of the new image.
    """
    c, tracks = session.config, session.tracks
    if len(tracks) == 0:
        return tracks, tracks.pixels

    def attempt(image: Pyramid, guess: NDArray[np.float32] | None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        return flow.track(
            image,
            after,
            tracks.pixels,
            guess,
            window_px=c.flow_window_px,
            levels=c.flow_levels,
            round_trip_px=c.flow_round_trip_px,
            min_correlation=c.flow_min_correlation,
        )

    guess = predict_pixels(session, tracks) if predict else None
    there, ok = attempt(before, guess)
    if ok.mean() < RETRY_SURVIVORS:
        others: list[tuple[Pyramid, NDArray[np.float32] | None]] = [(before, None)] if predict else []
        toned = match_tone(before.grey, after.grey)
        others += [(pyramid_of(toned, c.flow_levels), guess)] if toned is not None else []
        for again, ok_again in (attempt(*other) for other in others):
            if ok_again.sum() > ok.sum():
                there, ok = again, ok_again
    return Tracks(tracks.ids[ok], there[ok]), tracks.pixels[ok]


def readings(sensor: DepthSensor, frame: Frame, tracks: Tracks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what the sensor says of the inverse depth of tracks (N,) at every frame, and its sigma; NaN for nothing.

    Depth images are read for next to nothing. A stereo match costs as much as the tracking and waits for keyframes.
    """
    if isinstance(sensor, DepthImage):
        return sensor.inverse_depth(frame, tracks.pixels)
    unknown = np.full(len(tracks), np.nan)
    return unknown, unknown


def estimate(
    session: Session,
    tracks: Tracks,
    readings: tuple[NDArray[np.float64], NDArray[np.float64]],
    prediction: Prediction,
    start: PoseEstimate | None = None,
) -> tuple[PoseEstimate | None, NDArray[np.bool_]]:
    """Estimate the pose from the tracks with a landmark; returns it and which tracks (N,) it does not refute.

    ``readings`` are the inverse depths of the tracks and their sigmas, ``prediction`` is where the camera is expected,
    and ``start`` the pose of the same tracks before their pixels were settled.
    """
    c = session.config
    observations, known = session.observations(tracks, *readings)
    votes = static_votes(tracks.pixels[known], session.ages.of(tracks.ids[known]), session.camera)
    pose = None
    for threshold_px in dict.fromkeys((session.gate_px(), c.pnp_threshold_px)):  # once where they are the same
        pose = estimate_pose(
            observations,
            session.camera,
            threshold_px=threshold_px,
            iterations=c.pnp_iterations,
            pixel_sigma=c.pixel_sigma,
            minimum=c.min_inliers,
            prediction=prediction,
            votes=votes,
            start=start,
        )
        if pose is not None and votes[pose.inliers].sum() > MAJORITY * votes.sum():
            break
    keep = np.ones(len(tracks), bool)
    if pose is not None:
        keep[np.flatnonzero(known)[~pose.inliers]] = False
    return pose, keep


def abrupt(session: Session, pose: PoseEstimate) -> bool:
    """Return whether a pose rests on few of the last frame's tracks: after a jump, flow finds what is not there."""
    inliers = int(pose.inliers.sum())
    return inliers < session.config.good_inliers and inliers < ABRUPT_SHARE * len(session.tracks)


def settle(session: Session, image: Pyramid, tracks: Tracks, T_odom_cam: NDArray[np.float64]) -> Tracks:
    """Align tracks once more with their patches in the newest keyframe, warped as the pose says; undoes their drift."""
    reference, camera = session.reference, session.camera
    mine, theirs = shared(tracks.ids, reference.track_ids)
    known, positions, _ = session.landmarks.known(tracks.ids[mine])
    mine, theirs = mine[known], theirs[known]
    in_reference = se3.transform(se3.inverse(reference.T_odom_cam), positions)
    warps = patch_warps(se3.inverse(T_odom_cam) @ reference.T_odom_cam, in_reference, camera)
    with np.errstate(invalid="ignore", divide="ignore"):
        sound = np.abs(np.log(np.linalg.det(warps))) < MAX_LOG_SCALE
    mine, theirs, warps = mine[sound], theirs[sound], warps[sound]
    there, correlation = align_warped(reference.image, image, reference.seen[theirs], tracks.pixels[mine], warps)
    moved = np.linalg.norm(there - tracks.pixels[mine], axis=1)
    good = (correlation > MIN_CORRELATION) & (moved < MAX_SETTLING_PX)
    pixels = tracks.pixels.copy()
    pixels[mine[good]] = there[good]
    return Tracks(tracks.ids, pixels)


def patch_warps(
    T_now_reference: NDArray[np.float64], in_reference: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Return how small patches around points (N, 3) of the reference camera, facing it, change: (N, 2, 2), NaN
    behind.
    """

    def seen(points: NDArray[np.float64]) -> NDArray[np.float64]:
        in_now = se3.transform(T_now_reference, points)
        in_now[(in_now[:, 2] < MIN_DEPTH) | (points[:, 2] < MIN_DEPTH)] = np.nan
        return camera.project_ideal(in_now)

    centre = seen(in_reference)
    depth = in_reference[:, 2:]
    right = seen(in_reference + depth * (PATCH_PX / camera.fx, 0, 0))
    below = seen(in_reference + depth * (0, PATCH_PX / camera.fy, 0))
    return np.stack([right - centre, below - centre], axis=2) / PATCH_PX


def keyframe_due(session: Session, stamp_ns: int, n_inliers: int) -> bool:
    """Decide by what is still seen, rotation, parallax and the sensor's time, never by another clock."""
    c = session.config
    if n_inliers < max(c.good_inliers, c.keyframe_tracked_ratio * session.n_at_keyframe):
        return True
    return _moved_on(session, session.reference, stamp_ns) or map_keyframe_due(session, stamp_ns)


def map_keyframe_due(session: Session, stamp_ns: int) -> bool:
    """Decide whether the view differs enough from the newest keyframe of the map to be one more."""
    mapped = session.mapped
    if mapped is None:
        return True
    still_seen = len(shared(mapped.track_ids, session.tracks.ids)[0])
    if still_seen < max(session.config.good_inliers, session.config.keyframe_shared_ratio * len(mapped.track_ids)):
        return True
    return _moved_on(session, mapped, stamp_ns)


def _moved_on(session: Session, keyframe: WindowKeyframe, stamp_ns: int) -> bool:
    """Return whether the camera has turned or moved far since a keyframe, or at all within a long time."""
    c = session.config
    R_keyframe_cam = keyframe.T_odom_cam[:3, :3].T @ session.T_odom_cam[:3, :3]
    if float(se3.rotation_angle(R_keyframe_cam)) > np.deg2rad(c.keyframe_rotation_deg):
        return True
    i, j = shared(keyframe.track_ids, session.tracks.ids)
    if len(i) == 0:
        return True
    rays = session.camera.rays(session.tracks.pixels[j])
    parallax = float(np.median(rotation_compensated_parallax(R_keyframe_cam, keyframe.pixels[i], rays, session.camera)))
    waited_s = 1e-9 * (stamp_ns - keyframe.stamp_ns)
    return parallax > c.keyframe_parallax_px or (waited_s > c.keyframe_max_gap_s and parallax > STILL_PX)
