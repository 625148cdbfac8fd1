"""Triangulation of tracks over a window, against points that are known."""

import numpy as np

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.parallax import triangulate_tracks
from seamark.frontend.pyramid import pyramid_of
from seamark.frontend.window import WindowKeyframe

CAMERA = Camera(640, 480, 420, 410, 322, 238)
IMAGE = pyramid_of(np.zeros((480, 640), np.uint8), 0)
SETTINGS = {"min_angle_rad": np.deg2rad(0.9), "threshold_px": 2.5}
POINTS = np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 9), (60, 3))


def seen_from(x: float, ids: np.ndarray, noise_px: float = 0.0) -> WindowKeyframe:
    T = se3.make(se3.exp_rotation(np.array([0.0, 0.02 * x, 0.0])), np.array([x, 0.1 * x, 0.0]))
    pixels = CAMERA.project_ideal(se3.transform(se3.inverse(T), POINTS[ids]))
    pixels += np.random.default_rng(int(10 * x)).normal(size=pixels.shape) * noise_px
    unknown = np.full(len(ids), np.nan)
    return WindowKeyframe(None, 0, T, IMAGE, ids, pixels.astype(np.float32), pixels, unknown, unknown)


def test_tracks_get_the_points_they_are_of() -> None:
    """Test: three views in disorder, some tracks not wanted. Expected: exact points, from the oldest view."""
    rng = np.random.default_rng(1)
    oldest, middle = seen_from(0.0, rng.permutation(40)), seen_from(0.5, rng.permutation(50)[5:])
    newest = seen_from(0.9, rng.permutation(60))
    todo = newest.track_ids % 7 != 0
    rows, points, angle = triangulate_tracks(newest, [oldest, middle], todo, CAMERA, **SETTINGS)
    ids = newest.track_ids[rows]
    expected = set(newest.track_ids[todo]) & (set(oldest.track_ids) | set(middle.track_ids))
    assert len(ids) == len(expected) and set(ids) == expected
    np.testing.assert_allclose(points, POINTS[ids], atol=1e-6)
    origin = np.where(np.isin(ids, oldest.track_ids)[:, None], oldest.T_odom_cam[:3, 3], middle.T_odom_cam[:3, 3])
    a, b = POINTS[ids] - origin, POINTS[ids] - newest.T_odom_cam[:3, 3]
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    np.testing.assert_allclose(angle, np.arccos(cosine), atol=1e-6)


def test_a_view_that_will_not_do_leaves_the_track_to_the_next() -> None:
    """Test: tracks that jump in the oldest view, and a view without parallax. Expected: the middle view serves them."""
    ids = np.arange(60)
    oldest, middle, newest = seen_from(0.0, ids), seen_from(0.5, ids, 0.3), seen_from(0.9, ids, 0.3)
    oldest.pixels[:20, 1] += 40
    rows, points, _ = triangulate_tracks(newest, [oldest, middle], np.ones(60, bool), CAMERA, **SETTINGS)
    assert len(rows) > 50
    error = np.linalg.norm(points - POINTS[rows], axis=1)
    assert 0 < np.median(error) < 0.1
    assert len(triangulate_tracks(newest, [oldest], np.ones(60, bool), CAMERA, **SETTINGS)[0]) <= 40
    beside = seen_from(0.89, ids)
    for earlier in ([beside], []):
        assert len(triangulate_tracks(newest, earlier, np.ones(60, bool), CAMERA, **SETTINGS)[0]) == 0
    assert len(triangulate_tracks(newest, [oldest], np.zeros(60, bool), CAMERA, **SETTINGS)[0]) == 0
