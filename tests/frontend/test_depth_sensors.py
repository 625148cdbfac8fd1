"""What depth sensors say of pixels, against scenes of known depth."""

import cv2
import numpy as np
import pytest

from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import DepthImage, NoDepth, StereoPair
from seamark.frontend.types import Frame

CAMERA = Camera(320, 240, 250, 250, 160, 120)
CONFIG = FrontendConfig()
IMAGE = np.zeros((240, 320), np.uint8)
PIXELS = np.array([[50.2, 60.4], [200, 100], [0, 0], [319, 239], [160, 120]])


def depth_frame(depth: np.ndarray | None) -> Frame:
    return Frame(0, 0, IMAGE, None, depth)


@pytest.mark.parametrize(("dtype", "unit"), [(np.uint16, 5000), (np.float32, 1)])
def test_depth_images_are_read_in_their_units(dtype: type, unit: int) -> None:
    sensor = DepthImage(Rig(CAMERA, depth_factor=5000), CONFIG)
    inverse, sigma = sensor.inverse_depth(depth_frame(np.full((240, 320), 2.5 * unit).astype(dtype)), PIXELS)
    np.testing.assert_allclose(inverse, 0.4, rtol=1e-6)
    sigma_z = CONFIG.depth_sigma_floor_m + CONFIG.depth_sigma_per_m2 * 2.5**2
    np.testing.assert_allclose(sigma, sigma_z / 2.5**2, rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0, -1, CONFIG.depth_max_m + 1, CONFIG.depth_min_m / 2])
def test_depths_out_of_range_are_unknown(value: float) -> None:
    sensor = DepthImage(Rig(CAMERA), CONFIG)
    inverse, sigma = sensor.inverse_depth(depth_frame(np.full((240, 320), value, np.float32)), PIXELS)
    assert np.isnan(inverse).all()
    assert np.isnan(sigma).all()


def test_depth_survives_holes_and_is_unknown_at_edges() -> None:
    """Test: three of nine readings around one pixel, two around another, a step of 1 m at a third."""
    depth = np.full((240, 320), 2, np.float32)
    depth[20:40, 20:40] = 0
    depth[30, 29:32] = 2
    depth[25, 25:27] = 2
    depth[:, 200:] = 3
    pixels = np.array([[30, 30], [25, 25], [200, 100], [203, 100], [196, 100]])
    inverse, _ = DepthImage(Rig(CAMERA), CONFIG).inverse_depth(depth_frame(depth), pixels)
    np.testing.assert_allclose(inverse, [1 / 2, np.nan, np.nan, 1 / 3, 1 / 2], rtol=1e-6)


def test_without_a_picture_or_points_nothing_is_known() -> None:
    pair = Rig(CAMERA, CAMERA, se3.make(np.eye(3), np.array([0.1, 0, 0])))
    for sensor in (NoDepth(), DepthImage(pair, CONFIG), StereoPair(pair, CONFIG)):
        inverse, sigma = sensor.inverse_depth(depth_frame(None), PIXELS)
        assert np.isnan(inverse).all()
        assert np.isnan(sigma).all()
        frame = Frame(0, 0, IMAGE, IMAGE, np.ones((240, 320), np.float32))
        assert [len(values) for values in sensor.inverse_depth(frame, np.zeros((0, 2)))] == [0, 0]


@pytest.mark.parametrize("degrees", [0.0, 1.5])
def test_stereo_measures_a_plane_also_with_cameras_that_are_turned(degrees: float) -> None:
    """Test: a wall 3 m in front of a pair 0.12 m apart. Expected: right inverse depths, errors like their sigma."""
    noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2).astype(float)
    left = np.clip((blurred - blurred.mean()) * 5 + 128, 0, 255).astype(np.uint8)
    T_left_right = se3.make(se3.exp_rotation(np.deg2rad([0.3, degrees, degrees / 2])), np.array([0.12, 0.002, 0]))
    T_right_left = np.linalg.inv(T_left_right)
    plane = T_right_left[:3, :3] + np.outer(T_right_left[:3, 3], [0, 0, 1 / 3])  # of points with z = 3
    H = CAMERA.K @ plane @ np.linalg.inv(CAMERA.K)
    right = cv2.warpPerspective(left, H, (320, 240), flags=cv2.INTER_CUBIC)
    x, y = np.meshgrid(np.arange(40, 280, 10.0), np.arange(40, 200, 10.0))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    sensor = StereoPair(Rig(CAMERA, CAMERA, T_left_right), CONFIG)
    inverse, sigma = sensor.inverse_depth(Frame(0, 0, left, right), pixels)
    known = np.isfinite(inverse)
    assert known.mean() > 0.8
    np.testing.assert_array_equal(known, np.isfinite(sigma))
    error = (inverse[known] - 1 / 3) / sigma[known]
    assert abs(np.median(error)) < 0.2
    assert 0.005 < np.median(np.abs(error)) < 1
