"""The toy world against the pinhole model."""

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth.toy import LAP_RADIUS_M, ToyWorld, toy_sequence
from seamark.datasets_synth.trajectory import look
from seamark.frontend import se3
from seamark.frontend.types import Mode

EYE = np.array([-2.0, -1.8, 1.2])


@pytest.fixture(scope="module")
def world() -> ToyWorld:
    return ToyWorld(3, noise_grey=0.0)


def test_depth_lies_on_the_panels(world: ToyWorld) -> None:
    T_world_cam = look(EYE, 0.4, 0.1, 0.05)
    _, depth = world.view(T_world_cam)
    assert np.all(depth > 0)
    rows, columns = (index.ravel() for index in np.mgrid[5:240:10, 5:320:10])
    rays = world.camera.rays(np.column_stack([columns, rows]).astype(np.float64))
    points = se3.transform(T_world_cam, rays * depth[rows, columns][:, None])
    distances = np.stack([np.abs((points - panel.corner) @ panel.normal) for panel in world.panels])
    assert np.max(distances.min(axis=0)) < 1e-5


def test_known_points_appear_where_depth_and_pose_say(world: ToyWorld) -> None:
    """A corner of a panel must be an edge of the depth picture within half a pixel, and nearer things may cover it."""
    T_world_cam = look(EYE, 0.4)
    _, depth = world.view(T_world_cam)
    checked = 0
    for panel in world.panels[6:]:
        centre = panel.corners.mean(axis=0)
        in_camera = se3.transform(se3.inverse(T_world_cam), centre[None])
        if in_camera[0, 2] < 0.3 or (EYE - centre) @ panel.normal <= 0:
            continue
        pixel = np.rint(world.camera.project(in_camera)[0]).astype(int)
        if not (0 <= pixel[0] < 320 and 0 <= pixel[1] < 240):
            continue
        seen = depth[pixel[1], pixel[0]]
        assert seen < in_camera[0, 2] + 0.05
        checked += abs(seen - in_camera[0, 2]) < 0.05
    assert 2 <= checked <= 20


def _matches(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sift = cv2.SIFT_create(800, enable_precise_upscale=True)
    points_a, descriptors_a = sift.detectAndCompute(a, None)
    points_b, descriptors_b = sift.detectAndCompute(b, None)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_a, descriptors_b, 2)
    good = [first for first, second in pairs if first.distance < 0.7 * second.distance]
    return (
        np.array([points_a[match.queryIdx].pt for match in good]),
        np.array([points_b[match.trainIdx].pt for match in good]),
    )


def test_pictures_agree_with_depth_and_pose_to_half_a_pixel(world: ToyWorld) -> None:
    T_a, T_b = look(EYE, 0.4), look(EYE + np.array([0.1, 0.15, 0.05]), 0.45, 0.02, 0.02)
    frame_a, frame_b = world.render(T_a), world.render(T_b)
    points_a, points_b = _matches(frame_a.image, frame_b.image)
    assert len(points_a) > 150
    assert frame_a.depth is not None
    whole = np.rint(points_a).astype(int)
    depth = frame_a.depth[whole[:, 1], whole[:, 0]]
    predicted = world.camera.project(
        se3.transform(se3.inverse(T_b) @ T_a, world.camera.rays(points_a) * depth[:, None])
    )
    errors = predicted - points_b
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.5
    near = np.linalg.norm(errors, axis=1) < 2
    assert near.mean() > 0.85
    assert np.all(np.abs(np.median(errors[near], axis=0)) < 0.1)


def test_disparity_agrees_with_depth(world: ToyWorld) -> None:
    T_world_cam = look(EYE, 0.4)
    _, depth = world.view(T_world_cam)
    frame = world.render(T_world_cam, sensors=Mode.STEREO)
    assert frame.image_right is not None
    assert frame.depth is None
    points, right = _matches(frame.image, frame.image_right)
    whole = np.rint(points).astype(int)
    expected = world.camera.fx * world.baseline_m / depth[whole[:, 1], whole[:, 0]]
    errors = points[:, 0] - right[:, 0] - expected
    assert len(points) > 150
    assert np.median(np.abs(errors)) < 0.4
    assert abs(np.median(errors)) < 0.1
    assert np.median(np.abs(points[:, 1] - right[:, 1])) < 0.4
    rig = world.rig(Mode.STEREO)
    assert rig.T_cam0_cam1 is not None
    assert rig.T_cam0_cam1[0, 3] == pytest.approx(0.12)


def test_same_seed_same_bits() -> None:
    first, second = (list(toy_sequence("line", 3, seed=5).frames()) for _ in range(2))
    other = list(toy_sequence("line", 3, seed=6).frames())
    for a, b in zip(first, second, strict=True):
        assert a.image.tobytes() == b.image.tobytes()
        assert a.depth is not None and b.depth is not None
        assert a.depth.tobytes() == b.depth.tobytes()
        assert (a.index, a.stamp_ns, a.file) == (b.index, b.stamp_ns, b.file)
    assert np.mean(first[0].image != other[0].image) > 0.5


def test_loop_comes_back_to_its_start() -> None:
    sequence = toy_sequence("loop", 100)
    poses = sequence.ground_truth.T_world_cam
    distances = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    assert distances.max() == pytest.approx(2 * LAP_RADIUS_M, rel=0.02)
    assert distances[85:].min() < 0.1
    again = 85 + int(np.argmin(distances[85:]))
    assert se3.rotation_angle(poses[0, :3, :3].T @ poses[again, :3, :3]) < 0.1
    assert again < 99
    steps = np.diff(sequence.ground_truth.stamps_ns)
    assert np.all(steps > 0)
    frame = next(sequence.frames())
    assert frame.stamp_ns == sequence.ground_truth.stamps_ns[0]


@pytest.mark.parametrize("mode", [Mode.MONO, Mode.STEREO, Mode.RGBD])
def test_every_mode_gives_its_sensors(mode: Mode) -> None:
    sequence = toy_sequence("turn", 2, sensors=mode)
    frame = next(sequence.frames())
    assert (frame.depth is not None) == (mode is Mode.RGBD)
    assert (frame.image_right is not None) == (mode is Mode.STEREO)
    assert (sequence.rig.cam1 is not None) == (mode is Mode.STEREO)
    assert frame.image.shape == (240, 320, 3)
    assert frame.image.dtype == np.uint8


def test_grey_world() -> None:
    frame = ToyWorld(1, colour=False, size=(160, 120)).render(look(EYE, 0.0))
    assert frame.image.shape == (120, 160)


def test_unknown_trajectory_is_refused() -> None:
    with pytest.raises(SeamarkError, match="figure-eight"):
        toy_sequence("figure-eight")  # type: ignore[arg-type]
    with pytest.raises(SeamarkError, match="at least one frame"):
        toy_sequence("loop", 0)
