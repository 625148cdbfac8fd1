"""Flow, occlusion and place truth against panels in closed form and against what SIFT finds."""

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import ground_truth
from seamark.datasets_synth.ground_truth import epipolar_distances, flow, place_truth, visible
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.datasets_synth.trajectory import look
from seamark.frontend import se3
from seamark.frontend.camera import Camera

EYE = np.array([-2.0, -1.8, 1.2])
T_A, T_B = look(EYE, 0.4), look(EYE + np.array([0.25, 0.3, 0.05]), 0.5, 0.03, 0.04)


@pytest.fixture(scope="module")
def world() -> ToyWorld:
    return ToyWorld(3, noise_grey=0.0)


def _matches(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sift = cv2.SIFT_create(800, enable_precise_upscale=True)
    points_a, descriptors_a = sift.detectAndCompute(a, None)
    points_b, descriptors_b = sift.detectAndCompute(b, None)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_a, descriptors_b, 2)
    good = [first for first, second in pairs if first.distance < 0.7 * second.distance]
    both = [(points_a[m.queryIdx].pt, points_b[m.trainIdx].pt) for m in good]
    return np.array([p for p, _ in both]), np.array([q for _, q in both])


def test_flow_agrees_with_a_plane_in_closed_form() -> None:
    """A wall 4 m ahead and a step of 0.5 m to the right: every pixel moves by -fx 0.5 / 4, as a homography says."""
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    wall = np.full((120, 160), 4.0)
    T_a, T_b = np.eye(4), se3.make(np.eye(3), np.array([0.5, 0, 0]))
    moved = flow(wall, camera, T_a, T_b)
    assert moved.dtype == np.float32
    assert np.allclose(moved[..., 0], -130 * 0.5 / 4, atol=1e-4)
    assert np.allclose(moved[..., 1], 0, atol=1e-4)
    turned = se3.make(se3.exp_rotation(np.array([0.02, -0.05, 0.1])), np.array([0.1, -0.2, 0.3]))
    T_b_a = se3.inverse(turned)
    H = camera.K @ (T_b_a[:3, :3] + np.outer(T_b_a[:3, 3], [0, 0, 1]) / 4) @ np.linalg.inv(camera.K)
    pixel = np.array([30.0, 80.0, 1.0])
    expected = (H @ pixel)[:2] / (H @ pixel)[2] - pixel[:2]
    assert np.allclose(flow(wall, camera, T_a, turned)[80, 30], expected, atol=1e-3)


def test_flow_agrees_with_the_pictures(world: ToyWorld) -> None:
    image_a, depth = world.view(T_A)
    points_a, points_b = _matches(image_a, world.view(T_B)[0])
    whole = np.rint(points_a).astype(int)
    errors = np.linalg.norm(flow(depth, world.camera, T_A, T_B)[whole[:, 1], whole[:, 0]] - points_b + points_a, axis=1)
    assert len(points_a) > 120
    assert 0 < np.median(errors) < 0.5
    assert np.mean(errors < 2) > 0.8


def test_flow_there_and_back_ends_where_it_began_unless_hidden(world: ToyWorld) -> None:
    depth_a, depth_b = world.view(T_A)[1], world.view(T_B)[1]
    there, back = flow(depth_a, world.camera, T_A, T_B), flow(depth_b, world.camera, T_B, T_A)
    seen = visible(depth_a, depth_b, world.camera, T_A, T_B)
    rows, columns = np.nonzero(seen)
    rows, columns = rows[::4], columns[::4]
    targets = (np.column_stack([columns, rows]) + there[rows, columns]).astype(np.float32)
    returned = cv2.remap(back, targets[None, :, 0], targets[None, :, 1], cv2.INTER_LINEAR)[0]
    error = np.linalg.norm(there[rows, columns] + returned, axis=1)
    assert 0.4 < seen.mean() < 0.98
    assert np.median(error) < 0.01
    assert np.mean(error < 0.5) > 0.97  # the rest lies on edges of depth


def test_what_a_pillar_hides_is_not_visible() -> None:
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    wall = np.full((120, 160), 4.0)
    hidden = wall.copy()
    hidden[:, 60:100] = 2.0
    seen = visible(wall, hidden, camera, np.eye(4), np.eye(4))
    assert not seen[:, 60:100].any()
    assert seen[:, :60].all() and seen[:, 100:].all()
    away = look(np.array([0.0, 0, 0]), np.pi)
    assert not visible(wall, wall, camera, look(np.zeros(3), 0.0), away).any()


def test_unknown_depth_has_no_flow() -> None:
    camera = Camera(16, 12, 13.0, 13.0, 7.5, 5.5)
    depth = np.full((12, 16), 2.0)
    depth[3, 4], depth[5, 6] = 0.0, np.nan
    unknown = np.isnan(flow(depth, camera, np.eye(4), np.eye(4))[..., 0])
    assert unknown.sum() == 2 and unknown[3, 4] and unknown[5, 6]
    assert not visible(depth, depth, camera, np.eye(4), np.eye(4))[3, 4]
    with pytest.raises(SeamarkError, match="the camera 16x12"):
        flow(depth[:5], camera, np.eye(4), np.eye(4))


def test_what_moves_by_itself_has_its_own_flow() -> None:
    """A thing 2 m ahead that steps 0.1 m to the right, seen by a camera that steps 0.3 m: it moves by -fx 0.2 / 2."""
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    depth, labels = np.full((120, 160), 4.0), np.ones((120, 160), np.uint8)
    depth[40:80, 60:100], labels[40:80, 60:100] = 2.0, 34
    labels[40:80, 90:100] = 42
    T_a, T_b = look(EYE, 0.7), look(EYE, 0.7) @ se3.make(np.eye(3), np.array([0.3, 0, 0]))
    step = T_a @ se3.make(np.eye(3), np.array([0.1, 0, 0])) @ se3.inverse(T_a)
    moved = flow(depth, camera, T_a, T_b, labels, {34: step})
    assert np.allclose(moved[40:80, 60:90, 0], -130 * 0.2 / 2, atol=1e-3)
    assert np.allclose(moved[:40, :, 0], -130 * 0.3 / 4, atol=1e-3)
    assert np.isnan(moved[40:80, 90:100]).all() and np.isnan(moved).sum() == 40 * 10 * 2
    assert np.allclose(flow(depth, camera, T_a, T_b)[40:80, 60:100, 0], -130 * 0.3 / 2, atol=1e-3)
    turning = se3.make(se3.exp_rotation(np.array([0.1, 0.0, 0.3])), np.array([0.2, -0.1, 0.05]))
    point = se3.transform(turning, se3.transform(T_a, camera.rays(np.array([[70.0, 50.0]])) * 2.0))
    expected = camera.project(se3.transform(se3.inverse(T_b), point))[0] - (70, 50)
    assert np.allclose(flow(depth, camera, T_a, T_b, labels, {34: turning})[50, 70], expected, atol=1e-3)
    with pytest.raises(SeamarkError, match="labels are"):
        flow(depth, camera, T_a, T_b, labels[:5])


def test_place_truth_is_not_distance(world: ToyWorld) -> None:
    """The same spot seen in opposite directions is near and shares nothing; a step ahead shares nearly all."""
    poses = [T_A, T_B, look(EYE, 0.4 + np.pi), look(EYE + np.array([0.3, 0.13, 0]), 0.4), look(-EYE * (1, 1, -1), 0.4)]
    truth = place_truth([world.view(T)[1] for T in poses], poses, world.camera)
    assert np.allclose(np.diag(truth.shares), 1)
    assert truth.shares[0, 2] < 0.01 and truth.shares[2, 0] < 0.01
    assert 0.5 < truth.overlap[0, 1] < 0.99
    assert 0.6 < truth.overlap[0, 3] < 0.99
    assert truth.shares[3, 0] > truth.shares[0, 3]  # a step ahead sees less of what it saw, and nothing that is new
    exact = np.mean(visible(world.view(T_A)[1], world.view(T_B)[1], world.camera, T_A, T_B))
    assert truth.shares[0, 1] == pytest.approx(exact, abs=0.04)
    same = truth.same_place()
    assert np.array_equal(same, same.T)
    assert same[0, 1] and not same[0, 2]
    unrelated = truth.unrelated()
    assert np.array_equal(unrelated, unrelated.T)
    assert unrelated[0, 2] and not unrelated[0, 1]
    assert not np.any(same & unrelated)


def test_place_truth_finds_the_end_of_a_loop(world: ToyWorld) -> None:
    sequence = toy_sequence("loop", 100)
    chosen = list(range(0, 100, 5))
    poses = sequence.ground_truth.T_world_cam[chosen]
    depths = [world.view(pose)[1] for pose in poses]
    same = place_truth(depths, poses, sequence.rig.cam0).same_place()
    assert same[0, -1] and same[0, -2]  # 1.08 laps
    assert not same[0, len(chosen) // 2]
    assert all(same[k, k + 1] for k in range(len(chosen) - 1))
    with pytest.raises(SeamarkError, match="19 depth images for 20 poses"):
        place_truth(depths[:-1], poses, sequence.rig.cam0)
    with pytest.raises(SeamarkError, match="more depth images than the 19 poses"):
        place_truth(depths, poses[:-1], sequence.rig.cam0)


def test_matches_between_revisits_satisfy_the_true_epipolar_geometry(world: ToyWorld) -> None:
    sequence = toy_sequence("loop", 100)
    poses = sequence.ground_truth.T_world_cam
    early, late = (world.render(poses[index], index).image for index in (2, 96))
    points_a, points_b = _matches(early, late)
    T_a_b = se3.inverse(poses[2]) @ poses[96]
    assert len(points_a) > 60
    distances = epipolar_distances(points_a, points_b, sequence.rig.cam0, T_a_b)
    assert 0 < np.median(distances) < 1.0
    assert np.mean(distances < 2) > 0.75
    wrong = se3.inverse(poses[2]) @ poses[60]
    assert np.mean(epipolar_distances(points_a, points_b, sequence.rig.cam0, wrong) < 2) < 0.4
    with pytest.raises(SeamarkError, match="in one place"):
        epipolar_distances(points_a, points_b, sequence.rig.cam0, np.eye(4))


def test_epipolar_distance_of_exact_and_shifted_points() -> None:
    camera = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, (-0.2, 0.05, 0.001, -0.001))
    points = np.random.default_rng(0).uniform((-1, -0.8, 3), (1, 0.8, 6), (50, 3))
    T_a_b = se3.make(se3.exp_rotation(np.array([0.02, 0.05, -0.03])), np.array([0.4, 0.0, 0.0]))
    a, b = camera.project(points), camera.project(se3.transform(se3.inverse(T_a_b), points))
    assert epipolar_distances(a, b, camera, T_a_b).max() < 0.01
    plain = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
    sideways = se3.make(np.eye(3), np.array([0.4, 0, 0]))
    a, b = plain.project(points), plain.project(se3.transform(se3.inverse(sideways), points))
    assert np.allclose(epipolar_distances(a, b + np.array([0, 3]), plain, sideways), 3)
    assert ground_truth.SAME_PLACE_SHARE < 0.5
