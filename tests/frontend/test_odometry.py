"""The front end on the toy world: accuracy against exact poses, and a defined outcome for every bad frame."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend import se3
from seamark.frontend.camera import CalibrationError, Camera, Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import grey_of
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Frame, Keyframe, Mode, Odometry, Outcome, Quality

CONFIG = FrontendConfig(max_corners=250, sift_features=300)
WORLD = ToyWorld(7)


def track(
    mode: Mode, frames: Iterable[Frame], config: FrontendConfig = CONFIG
) -> tuple[list[Odometry], list[Keyframe]]:
    frontend = Frontend(WORLD.rig(mode), mode, config)
    odometry, keyframes = [], []
    try:
        for frame in frames:
            result = frontend.step(frame)
            odometry.append(result.odometry)
            keyframes += result.keyframes
        keyframes += frontend.finish()
    finally:
        frontend.close()
    return odometry, keyframes


def walk(trajectory: str, n: int, mode: Mode, *, of: int | None = None) -> tuple[list[Frame], np.ndarray]:
    sequence = toy_sequence(trajectory, of or n, sensors=mode, world=WORLD)
    frames = [frame for frame, _ in zip(sequence.frames(), range(n), strict=False)]
    return frames, sequence.ground_truth.T_world_cam


def errors(odometry: list[Odometry], truth: np.ndarray, first: int = 0) -> np.ndarray:
    """Return the distance of every posed frame from the truth, both relative to frame ``first``."""
    origin = odometry[first].T_odom_cam
    assert origin is not None
    out = []
    for frame, T in zip(odometry, truth, strict=False):
        if frame.T_odom_cam is not None:
            estimate = se3.inverse(origin) @ frame.T_odom_cam
            out.append(np.linalg.norm(estimate[:3, 3] - (np.linalg.inv(truth[first]) @ T)[:3, 3]))
    return np.array(out)


@pytest.mark.parametrize(("mode", "bound_m"), [(Mode.RGBD, 0.06), (Mode.STEREO, 0.06)])
def test_metric_odometry_follows_a_curve(mode: Mode, bound_m: float) -> None:
    frames, truth = walk("loop", 40, mode, of=160)
    odometry, keyframes = track(mode, frames)
    assert [o.outcome for o in odometry] == [Outcome.NEW_SESSION] + [Outcome.TRACKED] * 39
    assert np.isnan(odometry[0].reprojection_px)
    assert all(0 < o.reprojection_px < 1 for o in odometry[1:])
    length = np.linalg.norm(np.diff(truth[:40, :3, 3], axis=0), axis=1).sum()
    assert length > 3
    assert 0 < errors(odometry, truth).max() < bound_m
    assert 4 <= len(keyframes) <= 35
    for keyframe in keyframes:
        known = np.isfinite(keyframe.landmarks[:, 0])
        assert known.sum() > 40
        seen = WORLD.camera.project(keyframe.landmarks[known])
        np.testing.assert_allclose(seen, keyframe.features.points[known], atol=0.01)


def test_mono_odometry_has_the_right_shape_and_fills_in_its_beginning() -> None:
    frames, truth = walk("line", 50, Mode.MONO)
    odometry, keyframes = track(Mode.MONO, frames)
    start = next(i for i, o in enumerate(odometry) if o.outcome is Outcome.TRACKED)
    assert 3 < start < 25
    assert all(o.outcome is Outcome.INITIALISING for o in odometry[:start])
    assert all(o.outcome is Outcome.TRACKED for o in odometry[start:])
    assert [f.index for f in odometry[start].filled] == list(range(start))
    assert not keyframes[0].metric
    positions = np.stack([o.T_odom_cam[:3, 3] for o in odometry[start:]])
    true = truth[start:50, :3, 3]
    scale = np.linalg.norm(true[-1] - true[0]) / np.linalg.norm(positions[-1] - positions[0])
    steps = scale * np.linalg.norm(np.diff(positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, np.linalg.norm(np.diff(true, axis=0), axis=1), atol=0.012)
    filled = np.stack([f.T_reference_cam[:3, 3] for f in odometry[start].filled])
    lengths = scale * np.linalg.norm(filled, axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(truth[:start, :3, 3] - truth[0, :3, 3], axis=1), atol=0.03)


def test_turning_on_the_spot_invents_no_translation() -> None:
    frames, truth = walk("turn", 30, Mode.RGBD)
    odometry, _ = track(Mode.RGBD, frames)
    assert all(o.quality is not Quality.LOST for o in odometry)
    assert 0 < errors(odometry, truth).max() < 0.015
    R = odometry[0].T_odom_cam[:3, :3].T @ odometry[-1].T_odom_cam[:3, :3]
    R_true = truth[0][:3, :3].T @ truth[29][:3, :3]
    assert np.rad2deg(se3.rotation_angle(R.T @ R_true)) < 0.4
    mono, _ = track(Mode.MONO, [replace(f, depth=None) for f in frames])
    assert all(o.outcome is Outcome.INITIALISING for o in mono)


def test_mono_keeps_its_session_where_the_camera_turns_faster_than_it_moves() -> None:
    """Test: after 30 frames of a walk the camera turns by 90 degrees, five a frame, two millimetres a step.

    Expected: nothing that is seen at the end was seen from two places, yet there is one session, the angle is right and
    no way was invented (it is 4 cm; what the rotation is wrong by may look like a few more).
    """
    walked, truth = walk("line", 30, Mode.MONO)
    T, frames, true = truth[29], list(walked), list(truth[:30])
    for k in range(18):
        T = T @ se3.make(se3.exp_rotation(np.array([0.0, np.deg2rad(5.0), 0.0])), np.array([0.002, 0.0, 0.0]))
        true.append(T)
        stamp_ns = walked[-1].stamp_ns + (k + 1) * (walked[1].stamp_ns - walked[0].stamp_ns)
        frames.append(Frame(30 + k, stamp_ns, WORLD.view(T)[0]))
    odometry, _ = track(Mode.MONO, frames)
    start = next(i for i, o in enumerate(odometry) if o.outcome is Outcome.TRACKED)
    assert all(o.T_odom_cam is not None for o in odometry[start:])
    assert {o.session for o in odometry} == {0}
    estimated = np.stack([o.T_odom_cam for o in odometry[start:]])
    turned = estimated[-19][:3, :3].T @ estimated[-1][:3, :3]
    assert np.rad2deg(se3.rotation_angle(turned)) == pytest.approx(90, abs=1.5)
    walked_m, turning_m = (np.linalg.norm(b - a) for a, b in pairwise(estimated[[0, -19, -1], :3, 3]))
    true_m = np.linalg.norm(truth[29, :3, 3] - truth[start, :3, 3])
    assert turning_m * true_m / walked_m < 0.2


def test_same_frames_same_bits() -> None:
    frames, _ = walk("loop", 15, Mode.RGBD, of=160)
    (a, keyframes_a), (b, keyframes_b) = track(Mode.RGBD, frames), track(Mode.RGBD, frames)
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one.T_odom_cam, other.T_odom_cam)
    for one, other in zip(keyframes_a, keyframes_b, strict=True):
        np.testing.assert_array_equal(one.features.descriptors, other.features.descriptors)
        np.testing.assert_array_equal(one.landmarks, other.landmarks)


def black(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image))


def smaller(frame: Frame) -> Frame:
    return replace(frame, image=np.ascontiguousarray(frame.image[:-2]))


FAULTS: list[tuple[str, Callable[[Frame], Frame], Outcome]] = [
    ("black", black, Outcome.LOST),
    ("smaller", smaller, Outcome.WRONG_SIZE),
    ("depth of another size", lambda f: replace(f, depth=f.depth[::2, ::2]), Outcome.WRONG_SIZE),
    ("depth with channels", lambda f: replace(f, depth=f.depth[..., None]), Outcome.UNREADABLE),
    ("depth of another type", lambda f: replace(f, depth=f.depth.astype(np.int32)), Outcome.UNREADABLE),
    ("image of another type", lambda f: replace(f, image=f.image.astype(np.float32)), Outcome.UNREADABLE),
    ("image with alpha", lambda f: replace(f, image=np.dstack([grey_of(f.image)] * 4)), Outcome.UNREADABLE),
    ("stamp repeated", lambda f: replace(f, stamp_ns=f.stamp_ns - 66_666_667), Outcome.REPEATED_STAMP),
    ("stamp backward", lambda f: replace(f, stamp_ns=f.stamp_ns - 10**9), Outcome.STAMP_BACKWARD),
]


@pytest.mark.parametrize(("name", "fault", "expected"), FAULTS, ids=[name for name, *_ in FAULTS])
def test_one_bad_frame_does_no_harm(name: str, fault: Callable[[Frame], Frame], expected: Outcome) -> None:
    """Test: frame 8 of 16 is bad. Expected: its outcome says so, it has no pose, and the session goes on."""
    frames, truth = walk("loop", 16, Mode.RGBD, of=160)
    if name == "stamp repeated":
        frames[8] = replace(frames[8], stamp_ns=frames[7].stamp_ns)
    else:
        frames[8] = fault(frames[8])
    odometry, _ = track(Mode.RGBD, frames)
    assert odometry[8].outcome is expected
    assert odometry[8].T_odom_cam is None
    assert {o.session for i, o in enumerate(odometry) if i != 8} == {0}
    assert all(o.outcome in (Outcome.TRACKED, Outcome.RECOVERED) for o in odometry[9:])
    assert len(errors(odometry, truth)) == 15


RIGHT_FAULTS = [
    ("smaller", lambda image: image[:-2], Outcome.WRONG_SIZE),
    ("another type", lambda image: image.astype(np.uint16), Outcome.UNREADABLE),
]


@pytest.mark.parametrize(("name", "fault", "expected"), RIGHT_FAULTS, ids=[name for name, *_ in RIGHT_FAULTS])
def test_one_bad_right_image_does_no_harm(
    name: str, fault: Callable[[np.ndarray], np.ndarray], expected: Outcome
) -> None:
    """Test: the right image of frame 3 of 6 is bad. Expected: that frame is refused, the session goes on."""
    frames, _ = walk("loop", 6, Mode.STEREO, of=160)
    frames[3] = replace(frames[3], image_right=fault(frames[3].image_right))
    odometry, _ = track(Mode.STEREO, frames)
    assert [o.outcome for i, o in enumerate(odometry) if i] == [
        expected if i == 3 else Outcome.TRACKED for i in range(1, 6)
    ]


def test_colour_and_grey_images_give_the_same_poses() -> None:
    """Test: one or both images of a stereo pair are grey copies in three channels. Expected: not a bit differs."""
    frames, _ = walk("loop", 4, Mode.STEREO, of=160)
    grey = [replace(f, image=grey_of(f.image), image_right=grey_of(f.image_right)) for f in frames]
    colour = [replace(f, image_right=np.dstack([f.image_right] * 3)) for f in grey]
    for one, other in zip(track(Mode.STEREO, grey)[0], track(Mode.STEREO, colour)[0], strict=True):
        np.testing.assert_array_equal(one.T_odom_cam, other.T_odom_cam)


def test_a_picture_that_the_mode_does_not_read_may_be_anything() -> None:
    frames, _ = walk("loop", 2, Mode.RGBD, of=160)
    odd = [replace(f, image_right=np.zeros((2, 2), np.int8)) for f in frames]
    assert [o.outcome for o in track(Mode.RGBD, odd)[0]] == [Outcome.NEW_SESSION, Outcome.TRACKED]


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("size", [(1, 1), (2, 9), (24, 24)])
def test_images_with_next_to_no_pixels_are_survived(mode: Mode, size: tuple[int, int]) -> None:
    """Expected: LOST or, in mode places, a keyframe without features; no exception."""
    height, width = size
    camera = Camera(width, height, 50, 50, width / 2, height / 2)
    rig = Rig(camera, camera, se3.make(np.eye(3), np.array([0.1, 0, 0])))
    image = np.random.default_rng(0).integers(0, 255, size).astype(np.uint8)
    frames = [Frame(i, i, image, image, np.full(size, np.nan, np.float32)) for i in range(3)]
    frontend = Frontend(rig, mode, CONFIG)
    outcomes = {frontend.step(frame).odometry.outcome for frame in frames}
    keyframes = frontend.finish()
    frontend.close()
    assert outcomes == {Outcome.PLACE if mode is Mode.PLACES else Outcome.LOST}
    assert all(len(keyframe.features) <= 2 for keyframe in keyframes)


def test_a_jump_is_recovered_by_descriptors() -> None:
    """Test: 12 frames are missing. Expected: no new session, the pose after the gap is right."""
    frames, truth = walk("loop", 26, Mode.RGBD, of=160)
    kept = [i for i in range(26) if not 10 <= i < 22]
    odometry, _ = track(Mode.RGBD, [frames[i] for i in kept])
    assert {o.session for o in odometry} == {0}
    assert errors(odometry, truth[kept]).max() < 0.05


def test_after_a_long_blackout_a_new_session_begins() -> None:
    """Test: 1 s of black, then the other side of the room. Expected: LOST, then session 1; odometry does not jump."""
    frames, _ = walk("loop", 160, Mode.RGBD)
    dark = [black(replace(frames[10 + i])) for i in range(15)]
    after = [replace(frames[80 + i], stamp_ns=frames[25 + i].stamp_ns) for i in range(6)]
    odometry, keyframes = track(Mode.RGBD, [*frames[:10], *dark, *after])
    assert all(o.quality is Quality.LOST for o in odometry[10:25])
    assert odometry[25].outcome is Outcome.NEW_SESSION
    assert {o.session for o in odometry[25:]} == {1}
    jump = se3.inverse(odometry[9].T_odom_cam) @ odometry[25].T_odom_cam
    np.testing.assert_allclose(jump, np.eye(4), atol=1e-9)
    first_of_second = next(k for k in keyframes if k.session == 1)
    assert first_of_second.previous_id is None


def test_depth_full_of_rubbish_is_ignored() -> None:
    """Test: a third of the depth is NaN, infinite or negative. Expected: tracked, nearly as well as with good depth."""
    frames, truth = walk("loop", 20, Mode.RGBD, of=160)
    rng = np.random.default_rng(0)
    spoiled = []
    for frame in frames:
        depth = frame.depth.copy()
        depth[:, ::9] = np.nan
        depth[rng.random(depth.shape) < 0.1] = np.inf
        depth[rng.random(depth.shape) < 0.1] = -1
        spoiled.append(replace(frame, depth=depth))
    odometry, _ = track(Mode.RGBD, spoiled)
    assert all(o.quality is not Quality.LOST for o in odometry)
    assert 0 < errors(odometry, truth).max() < 0.04


def test_places_makes_every_frame_a_keyframe_without_a_pose() -> None:
    frames, _ = walk("loop", 4, Mode.MONO, of=160)
    frontend = Frontend(None, Mode.PLACES, CONFIG)
    odometry = [frontend.step(f).odometry for f in frames]
    nothing = frontend.step(replace(frames[-1], image=np.zeros((0, 10), np.uint8)))
    frontend.close()
    assert nothing.odometry.outcome is Outcome.UNREADABLE
    assert [o.keyframe_id for o in odometry] == [0, 1, 2, 3]
    assert all(o.T_odom_cam is None and o.outcome is Outcome.PLACE for o in odometry)


def test_in_mode_places_a_calibration_holds_for_images_of_its_size() -> None:
    """Test: an image of another size among calibrated ones. Expected: a keyframe too, but without a camera."""
    frames, _ = walk("loop", 2, Mode.MONO, of=160)
    odometry, keyframes = track(Mode.PLACES, [frames[0], smaller(frames[1])])
    assert [o.outcome for o in odometry] == [Outcome.PLACE] * 2
    assert [k.camera for k in keyframes] == [WORLD.camera, None]


def test_modes_need_their_calibration() -> None:
    with pytest.raises(CalibrationError, match="calibration"):
        Frontend(None, Mode.MONO, CONFIG)
    with pytest.raises(CalibrationError, match="both cameras"):
        Frontend(WORLD.rig(Mode.RGBD), Mode.STEREO, CONFIG)
    pair = WORLD.rig(Mode.STEREO)
    with pytest.raises(CalibrationError, match="one size, not"):
        Frontend(replace(pair, cam1=replace(pair.cam1, width=pair.cam1.width + 2)), Mode.STEREO, CONFIG)
