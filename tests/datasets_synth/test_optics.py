"""Light and camera models against independent computations, without a simulator."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import lighting, optics, sensor
from seamark.datasets_synth.optics import Lens
from seamark.frontend import se3
from seamark.frontend.camera import Camera

BARREL = Camera(160, 120, 102.5, 102.5, 79.5, 59.5, optics.MODELS["barrel"].distortion)


class TestLight:
    def test_day_indoors_changes_nothing(self) -> None:
        assert lighting.illumination("day", False, 0.3) == lighting.Illumination()

    @pytest.mark.parametrize("outdoors", [False, True])
    def test_it_gets_darker_from_day_to_night(self, outdoors: bool) -> None:
        ambient = [sum(lighting.illumination(name, outdoors, 0).ambient) for name in ("day", "dusk", "night")]
        assert ambient[0] > 2 * ambient[1] > 4 * ambient[2] > 0

    def test_changing_light_is_steady_but_for_the_switch(self) -> None:
        lights = [lighting.illumination("changing", False, share) for share in np.linspace(0, 1, 601)]
        ambient = np.array([light.ambient for light in lights])
        assert np.abs(np.diff(ambient, axis=0)).max() < 0.01
        assert ambient[-1].max() < 0.3 < ambient[0].max()
        lamps = np.array([light.lamps[0] for light in lights])
        assert (np.abs(np.diff(lamps)) > 0.3).sum() == 2


class TestExposure:
    def test_it_follows_late_and_settles(self) -> None:
        automatic = optics.AutomaticExposure()
        bright, dark = (np.full((6, 8, 3), 255 * linear ** (1 / 2.2), np.float32) for linear in (0.36, 0.09))
        assert automatic.follow(bright) == pytest.approx(0.5, rel=1e-3)
        after = [automatic.follow(dark) for _ in range(25)]
        assert after[0] == pytest.approx(0.5, rel=1e-3)  # not seen yet
        assert after[1] == pytest.approx(0.5 * 4**0.3, rel=1e-3)
        assert after[-1] == pytest.approx(2.0, rel=1e-2)
        assert all(a < b for a, b in pairwise(after))

    def test_a_longer_shutter_comes_before_gain(self) -> None:
        model = optics.MODELS["real"]
        for factor, shutter, gain in ((0.5, 0.5, 1), (2, 2, 1), (3, 3, 1), (12, 3, 4)):
            exposure = optics.split_exposure(factor, model)
            assert exposure.shutter_s == pytest.approx(shutter * model.shutter_s)
            assert exposure.gain == pytest.approx(gain)

    def test_noise_grows_with_the_root_of_the_gain(self) -> None:
        grey, model = np.full((200, 200, 3), 120, np.float32), sensor.MODELS["mild"]
        one, nine = (sensor.expose(grey, model, np.random.default_rng(0), gain).std() for gain in (1.0, 9.0))
        assert 2.8 < nine / one < 3.1


class TestLens:
    def test_it_puts_points_where_the_camera_sees_them(self) -> None:
        lens = Lens(BARREL)
        picture = np.zeros((lens.wide.height, lens.wide.width, 3), np.float32)
        points = np.array([[x, y, 2.0] for x in (-1.1, -0.3, 0.8) for y in (-0.7, 0.2, 0.8)])
        for u, v in lens.wide.project(points):
            y, x = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]]
            picture += np.exp(-((x - u) ** 2 + (y - v) ** 2) / 4.5)[..., None].astype(np.float32)
        seen = lens.colour(picture)[..., 0]
        for u, v in BARREL.project(points):
            column, row = round(u), round(v)
            window = seen[row - 4 : row + 5, column - 4 : column + 5].astype(np.float64)
            offsets = np.arange(-4, 5)
            found = np.array([(window.sum(axis=0) @ offsets), (window.sum(axis=1) @ offsets)]) / window.sum()
            assert np.hypot(found[0] + column - u, found[1] + row - v) < 0.25

    def test_depth_of_a_plane_stays_exact(self) -> None:
        lens = Lens(BARREL)
        normal, distance = np.array([0.1, 0.9, 0.4]), 1.3  # a floor: normal . X = distance

        def plane(camera: Camera) -> np.ndarray:
            y, x = np.mgrid[0 : camera.height, 0 : camera.width]
            slope = camera.rays(np.stack([x.ravel(), y.ravel()], axis=1)) @ normal
            z = np.where(slope > 0.2, distance / np.maximum(slope, 0.2), 0)
            return z.reshape(camera.height, camera.width).astype(np.float32)

        mapped, exact = lens.depth(plane(lens.wide)), plane(BARREL)
        both = (mapped > 0) & (exact > 0)
        assert both.mean() > 0.5
        assert np.percentile(np.abs(mapped - exact)[both] / exact[both], 99) < 2e-3

    def test_without_distortion_nothing_is_touched(self) -> None:
        camera = Camera(160, 120, 102.5, 102.5, 79.5, 59.5)
        picture = np.zeros((120, 160, 3), np.float32)
        assert Lens(camera).colour(picture) is picture
        assert optics.vignette(camera, 0.0) is None

    def test_corners_lose_what_the_model_says(self) -> None:
        factor = optics.vignette(BARREL, 0.5)
        assert factor is not None
        assert factor[0, 0, 0] ** 2.2 == pytest.approx(0.5, abs=0.01)
        assert factor[60, 80, 0] == pytest.approx(1.0, abs=1e-3)


class TestBlur:
    CAMERA = Camera(160, 120, 102.5, 102.5, 79.5, 59.5)

    def test_motion_of_pixels_is_reprojection(self) -> None:
        rng = np.random.default_rng(1)
        depth = rng.uniform(1.5, 6.0, (120, 160)).astype(np.float32)
        T_later_now = se3.make(se3.exp_rotation(np.array([0.02, -0.03, 0.01])), np.array([0.05, 0.02, -0.2]))
        motion = optics.image_motion(self.CAMERA, depth, T_later_now)
        for row, column in ((3, 5), (60, 80), (110, 150)):
            now = np.array([[column, row]], np.float64)
            point = self.CAMERA.rays(now) * float(depth[row, column])
            later = self.CAMERA.project(se3.transform(T_later_now, point))
            assert np.allclose(motion[row, column], (later - now)[0], atol=0.01)

    def test_a_line_gets_as_wide_as_it_moves(self) -> None:
        picture = np.zeros((40, 80, 3), np.float32)
        picture[:, 40] = 240
        motion = np.zeros((40, 80, 2), np.float32)
        motion[..., 0] = 8
        blurred = optics.blur(picture, motion)
        assert blurred[20, :, 0].sum() == pytest.approx(240, rel=0.01)
        assert 7 <= (blurred[20, :, 0] > 10).sum() <= 10
        assert blurred[20, :, 0] @ np.arange(80) / blurred[20, :, 0].sum() == pytest.approx(40, abs=0.05)

    def test_a_camera_at_rest_gives_sharp_pictures(self) -> None:
        picture = cv2.randu(np.zeros((40, 80, 3), np.float32), 0, 255)
        assert optics.blur(picture, np.zeros((40, 80, 2), np.float32)) is picture


def _waves(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A picture that is known between pixels too."""
    total = np.full((*x.shape, 3), 120.0)
    for _ in range(12):
        f, phase = rng.uniform(-0.35, 0.35, 2), rng.uniform(0, 6, 3)
        total += 18 * np.sin((f[0] * x + f[1] * y)[..., None] + phase)
    return total


class TestBlurOfWhatMoves:
    """A square that moves by (10, 4) px before a picture that moves by (-5, 0)."""

    SQUARE, REST = np.array([10.0, 4.0]), np.array([-5.0, 0.0])

    def _scene(self, share: float) -> tuple[np.ndarray, np.ndarray]:
        y, x = np.mgrid[0:90, 0:120].astype(np.float64)
        own_x, own_y = x - share * self.SQUARE[0], y - share * self.SQUARE[1]
        mask = (np.abs(own_x - 60) < 20.5) & (np.abs(own_y - 45) < 20.5)
        behind = _waves(np.random.default_rng(0), x - share * self.REST[0], y - share * self.REST[1])
        square = 40 + _waves(np.random.default_rng(1), own_x, own_y)
        return np.where(mask[..., None], square, behind).astype(np.float32), mask

    def test_it_is_the_mean_over_the_time_that_the_shutter_is_open(self) -> None:
        exact = np.mean([self._scene(share)[0] for share in (np.arange(64) + 0.5) / 64 - 0.5], axis=0)
        picture, mask = self._scene(0.0)
        motion = np.broadcast_to(self.REST.astype(np.float32), (90, 120, 2))
        moving = np.broadcast_to(self.SQUARE.astype(np.float32), (90, 120, 2))
        right = np.abs(optics.blur_moving(picture, motion, moving, mask) - exact).mean(axis=2)
        as_if_still = np.abs(optics.blur(picture, motion) - exact).mean(axis=2)
        inside = cv2.erode(mask.astype(np.uint8), np.ones((13, 13))) > 0
        about = (cv2.dilate(mask.astype(np.uint8), np.ones((15, 15))) > 0) & ~mask
        assert 0 < right[inside].mean() < 0.15 * as_if_still[inside].mean()
        assert 0 < right[about].mean() < 0.5 * as_if_still[about].mean()
        edge = mask & ~inside  # what lies behind is not in the picture there
        assert right[edge].mean() < 0.7 * as_if_still[edge].mean()

    def test_its_edge_is_as_wide_as_its_own_motion(self) -> None:
        mask = np.zeros((60, 120), np.bool_)
        mask[20:40, 40:80] = True
        picture = np.where(mask[..., None], np.float32(200), np.float32(0)) * np.ones(3, np.float32)
        moving = np.zeros((60, 120, 2), np.float32)
        moving[..., 0] = 8
        blurred = optics.blur_moving(picture, np.zeros_like(moving), moving, mask)[..., 0]
        ramp = (blurred[30] > 10) & (blurred[30] < 190)
        assert 6 <= ramp[30:50].sum() <= 9 and 6 <= ramp[70:90].sum() <= 9
        assert ((blurred[:, 60] > 10) & (blurred[:, 60] < 190)).sum() == 0  # no motion across
        assert blurred[30].sum() == pytest.approx(picture[30, :, 0].sum(), rel=1e-3)

    def test_motion_of_moving_pixels_is_reprojection_of_their_own_motion(self) -> None:
        camera = TestBlur.CAMERA
        depth = np.random.default_rng(2).uniform(1.5, 4.0, (120, 160)).astype(np.float32)
        labels = np.ones((120, 160), np.uint8)
        labels[30:60, 40:70], labels[30:60, 70:90] = 32, 33
        parts = {
            32: se3.make(se3.exp_rotation(np.array([0.0, 0.04, 0.01])), np.array([0.1, 0.0, -0.1])),
            33: se3.make(np.eye(3), np.array([-0.05, 0.02, 0.0])),
        }
        found = optics.moving_motion(camera, depth, labels, parts)
        assert found is not None
        motion, mask = found
        assert np.array_equal(mask, labels > 1)
        for row, column in ((31, 41), (50, 65), (40, 80)):
            point = camera.rays(np.array([[column, row]], np.float64)) * float(depth[row, column])
            later = camera.project(se3.transform(parts[int(labels[row, column])], point))[0]
            assert np.allclose(motion[row, column], later - (column, row), atol=0.01)
        assert np.allclose(motion[20, 60], motion[30, 60], atol=1e-6)  # goes on about the edge
        assert optics.moving_motion(camera, depth, np.ones_like(labels), parts) is None
