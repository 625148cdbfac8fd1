"""Landmarks of earlier keyframes, seen again, against exact poses of the toy world."""

from typing import Any

import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld
from seamark.frontend import se3
from seamark.frontend.config import FrontendConfig
from seamark.frontend.corners import detect_corners
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.features import grey_of
from seamark.frontend.odometry import Frontend
from seamark.frontend.pyramid import pyramid_of
from seamark.frontend.revisit import find_again, worth_revisiting
from seamark.frontend.session import Session
from seamark.frontend.tracks import Tracks
from seamark.frontend.types import Frame, Mode
from seamark.frontend.window import BundleProblem, BundleResult, WindowKeyframe, adjust

WORLD = ToyWorld(5)
CONFIG = FrontendConfig(max_corners=250, sift_features=200)


def looking(yaw: float) -> np.ndarray:
    """Return the pose of a camera in the room that has turned by ``yaw`` and stepped aside a little with it."""
    turn = se3.make(se3.exp_rotation(np.array([0.0, 0.0, yaw])), np.array([0.15 * np.sin(yaw), 0.1 * yaw, 1.2]))
    return turn @ se3.T_WORLD_LEVEL_CAM


def keyframe_of(frame: Frame, T: np.ndarray) -> tuple[WindowKeyframe, np.ndarray]:
    """Return a keyframe with exact landmarks, and their positions in the world."""
    grey = grey_of(frame.image)
    seen = detect_corners(grey, np.zeros((0, 2)), 250, harris=False, min_response=CONFIG.min_corner_response)
    depth = frame.depth[np.rint(seen[:, 1]).astype(int), np.rint(seen[:, 0]).astype(int)]
    positions = se3.transform(T, WORLD.camera.rays(seen) * depth[:, None])
    unknown = np.full(len(seen), np.nan)
    ids = np.arange(len(seen))
    return WindowKeyframe(0, 0, T, pyramid_of(grey, 4), ids, seen, seen.astype(float), unknown, unknown), positions


@pytest.mark.parametrize("error_m", [0.0, 0.04])
def test_landmarks_are_found_where_the_truth_projects_them(error_m: float) -> None:
    """Test: the pose is off by up to 4 cm. Expected: most landmarks in view are found, at their true pixels."""
    T_old, T_now = looking(0.0), looking(0.12)
    old, positions = keyframe_of(WORLD.render(T_old), T_old)
    assert len(positions) > 80
    T_believed = T_now @ se3.make(np.eye(3), np.array([error_m, 0, 0]))
    image = pyramid_of(grey_of(WORLD.render(T_now, index=1).image), 4)
    live = Tracks(old.track_ids[:20], np.zeros((20, 2), np.float32))
    found = find_again(old, positions, image, T_believed, WORLD.camera, live, CONFIG)
    assert not np.isin(found.ids, live.ids).any()
    assert len(found) > 0.4 * len(positions)
    true = WORLD.camera.project(se3.transform(se3.inverse(T_now), positions[found.ids]))
    error = np.linalg.norm(true - found.pixels, axis=1)
    assert np.median(error) < 0.3
    assert np.mean(error < 2) > 0.93


def test_nothing_is_found_in_another_view_or_without_landmarks() -> None:
    T_old = looking(0.0)
    old, positions = keyframe_of(WORLD.render(T_old), T_old)
    image = pyramid_of(grey_of(WORLD.render(looking(np.pi)).image), 4)
    elsewhere = find_again(old, positions, image, T_old, WORLD.camera, Tracks.none(), CONFIG)
    assert len(elsewhere) < 0.1 * len(positions)
    unknown = np.full_like(positions, np.nan)
    assert len(find_again(old, unknown, old.image, T_old, WORLD.camera, Tracks.none(), CONFIG)) == 0


def test_the_views_most_alike_are_worth_revisiting() -> None:
    frame = WORLD.render(looking(0.0))
    yaws = [0.0, 0.1, 0.2, 0.3, 1.5]
    archive = [keyframe_of(frame, looking(yaw))[0] for yaw in yaws]
    chosen = worth_revisiting(archive, looking(0.28), 3.0, CONFIG)
    assert [yaws[archive.index(old)] for old in chosen] == [0.3, 0.2, 0.1]
    assert worth_revisiting(archive, looking(2.5), 3.0, CONFIG) == []
    assert worth_revisiting([], looking(0.0), 3.0, CONFIG) == []


def test_a_camera_that_looks_to_and_fro_does_not_drift() -> None:
    """Test: six sweeps over one wall. Expected: with keyframes revisited the error stays at that of the first sweep."""
    yaws = np.concatenate([np.linspace(0, 1.1, 14), np.linspace(1.1, 0, 14)] * 3)
    poses = [looking(yaw) for yaw in yaws]
    frames = [WORLD.render(T, k, (k + 1) * 66_000_000) for k, T in enumerate(poses)]

    def last_errors(config: FrontendConfig) -> np.ndarray:
        frontend = Frontend(WORLD.rig(Mode.RGBD), Mode.RGBD, config)
        estimates = [frontend.step(frame).odometry.T_odom_cam for frame in frames]
        frontend.close()
        origin = se3.inverse(estimates[0])
        true = [se3.inverse(poses[0]) @ T for T in poses]
        moved = [np.linalg.norm((origin @ T)[:3, 3] - t[:3, 3]) for T, t in zip(estimates, true, strict=True)]
        return np.array(moved[-14:])

    kept, forgotten = (last_errors(CONFIG.model_copy(update={"revisit_keyframes": n})) for n in (3, 0))
    assert 0 < kept.mean() < 0.03
    assert kept.mean() < 0.8 * forgotten.mean()


def test_keyframes_that_have_left_the_window_hold_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Test: four keyframes have left the window; one shares too few landmarks with it. Expected: the two newest of the
    others take part in the adjustment, held still, and no more than are asked for.
    """
    config = FrontendConfig(covisible_keyframes=2, revisit_min_landmarks=12)
    points = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 6), (60, 3))
    session = Session(0, config, WORLD.camera, True, np.eye(4), DepthOffset.expected(0.0))
    session.landmarks.set(np.arange(60), points, np.full(60, 0.01))

    def keyframe(number: int, ids: np.ndarray) -> WindowKeyframe:
        T = se3.make(np.eye(3), np.array([0.1 * number, 0, 0]))
        pixels = WORLD.camera.project_ideal(se3.transform(se3.inverse(T), points[ids]))
        image, unknown = pyramid_of(np.zeros((64, 64), np.uint8), 0), np.full(len(ids), np.nan)
        return WindowKeyframe(number, number, T, image, ids, pixels.astype(np.float32), pixels, unknown, unknown)

    everything = np.arange(60)
    session.archive = [keyframe(k, everything) for k in range(3)] + [keyframe(3, everything[:5])]
    session.window = [keyframe(k, everything) for k in (4, 5)]
    given = []

    def watched(problem: BundleProblem, *rest: Any, **settings: Any) -> BundleResult:
        given.append(problem)
        return adjust(problem, *rest, **settings)

    monkeypatch.setattr("seamark.frontend.session.adjust", watched)
    session.adjust_window()
    assert [round(10 * T[0, 3]) for T in given[0].poses] == [2, 1, 4, 5]
    assert given[0].n_fixed == 3
