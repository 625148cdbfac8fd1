"""A pose that is already known, refined on pixels that have moved a little."""

import numpy as np

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.pose import estimate_pose
from seamark.frontend.residuals import Observations

CAMERA = Camera(640, 480, 420, 410, 322, 238)
SETTINGS = {"threshold_px": 2.5, "iterations": 150, "pixel_sigma": 0.7, "minimum": 15}


def test_a_start_gives_the_pose_that_sampling_gives() -> None:
    """Test: the pixels move a little, a third are wrong. Expected: the same pose and inliers as from nothing."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, (120, 2)), rng.uniform(3, 9, 120)])
    pixels = CAMERA.project_ideal(points) + rng.normal(size=(120, 2)) * 1.0
    pixels[:40] += rng.uniform(20, 60, (40, 2))
    unknown = np.full(120, np.nan)
    first = estimate_pose(Observations(points, pixels, unknown, unknown), CAMERA, **SETTINGS)
    assert first is not None
    better = Observations(points, CAMERA.project_ideal(points), unknown, unknown)
    better.pixels[:40] = pixels[:40]
    fresh, refined = (estimate_pose(better, CAMERA, **SETTINGS, start=start) for start in (None, first))
    assert fresh is not None and refined is not None
    np.testing.assert_array_equal(refined.inliers, np.arange(120) >= 40)
    np.testing.assert_array_equal(refined.inliers, fresh.inliers)
    np.testing.assert_allclose(refined.T_odom_cam, np.eye(4), atol=1e-6)
    assert np.abs(first.T_odom_cam - np.eye(4)).max() > 1e-3
    nonsense = se3.make(se3.exp_rotation(np.array([0.0, 3.0, 0.0])), np.zeros(3))
    lost = type(first)(nonsense, first.inliers, 0.5, np.eye(6))
    assert estimate_pose(better, CAMERA, **SETTINGS, start=lost) is None
