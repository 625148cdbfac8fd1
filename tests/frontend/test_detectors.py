"""Where corners and key points are taken: in the dark, under masks, and at which scale."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.camera import Camera
from seamark.frontend.corners import detect_corners
from seamark.frontend.features import extract_features
from seamark.frontend.harris_laplace import harris_laplace
from seamark.frontend.masks import MaskError, allowed, combined, read_mask

NOWHERE = np.zeros((0, 2))
WORLD = ToyWorld(7, size=(640, 480))
POSES = toy_sequence("loop", 160, world=WORLD).ground_truth.T_world_cam


def view(place: int) -> np.ndarray:
    return cv2.cvtColor(WORLD.view(POSES[place])[0], cv2.COLOR_BGR2GRAY)


def blurred_noise(sigma: float, contrast: float) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((480, 640)), (0, 0), sigma)
    return np.clip(np.rint(128 + contrast * noise / noise.std()), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("harris", [False, True])
@pytest.mark.parametrize("place", [0, 40, 90])
def test_at_an_eighth_of_the_brightness_the_corners_stay(place: int, harris: bool) -> None:
    """Expected: at least 70 % of the corners have one within 1.5 pixels in the dark image, and not many more appear."""
    image = view(place)
    light, dark = (detect_corners(one, NOWHERE, 420, harris=harris, min_response=2e-5) for one in (image, image // 8))
    assert len(light) > 150
    distance = np.linalg.norm(light[:, None] - dark[None], axis=2).min(axis=1)
    assert (distance < 1.5).mean() >= 0.7
    assert len(dark) < 1.25 * len(light)


def test_low_texture_gives_corners_and_noise_alone_gives_none() -> None:
    """Test: smooth texture of 2 grey levels (sigma); a wall with noise of 0.6. Expected: corners; none."""
    faint = blurred_noise(3.0, 2.0)
    assert len(detect_corners(faint, NOWHERE, 420, harris=False, min_response=2e-5)) > 200
    wall = np.rint(90 + np.random.default_rng(1).normal(0, 0.6, (480, 640))).astype(np.uint8)
    assert len(detect_corners(wall, NOWHERE, 420, harris=False, min_response=2e-5)) == 0


@pytest.mark.parametrize("harris", [False, True])
def test_nothing_is_taken_under_a_mask(harris: bool) -> None:
    image, mask = view(0), np.full((480, 640), 255, np.uint8)
    mask[200:] = 0
    corners = detect_corners(image, NOWHERE, 420, harris=harris, min_response=2e-5)
    left = detect_corners(image, NOWHERE, 420, harris=harris, min_response=2e-5, mask=mask)
    assert (corners[:, 1] > 210).sum() > 30
    assert 50 < len(left) < len(corners)
    assert left[:, 1].max() < 204
    points = extract_features(image, 500, mask=mask).points
    assert len(points) > 50
    assert points[:, 1].max() < 200.5


def test_masks_are_read_checked_and_combined(tmp_path: Path) -> None:
    camera = Camera(4, 3, 5, 5, 1.5, 1)
    first = np.full((3, 4), 255, np.uint8)
    first[0] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), first)
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", camera), first)
    second = np.eye(3, 4, dtype=np.uint8)
    both = combined(first, second)
    np.testing.assert_array_equal(both > 0, (first > 0) & (second > 0))
    assert combined(None, None) is None
    assert combined(first, None) is first and combined(None, second) is second
    points = np.array([[1.4, 0.6], [1.4, 0.4], [2, 2], [-3, 99], [9, -9]])
    assert allowed(first, points).tolist() == [True, False, True, True, False]
    assert allowed(None, points).all()
    with pytest.raises(MaskError, match="4 x 3 pixels, not 8 x 3"):
        read_mask(tmp_path / "mask.png", Camera(8, 3, 5, 5, 1, 1))
    with pytest.raises(MaskError, match="cannot be read"):
        read_mask(tmp_path / "nowhere.png", None)


@pytest.mark.parametrize("place", [0, 60])
def test_harris_laplace_finds_half_the_scale_from_twice_as_far(place: int) -> None:
    """Test: an image and the same at half size. Expected: the same corners at half the scale.

    Of the corners with 3.8 to 9 pixels of scale (the ladder begins at 1.6) at least half are found again, in the median
    at 0.5 of it within 15 per cent, and three of four of them so.
    """
    image = view(place)
    near = harris_laplace(image, min_response=2e-4)
    far = harris_laplace(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), min_response=2e-4)
    distance = np.linalg.norm(((near.points + 0.5) / 2 - 0.5)[:, None] - far.points[None], axis=2)
    nearest = distance.argmin(axis=1)
    comparable = (near.scales > 3.8) & (near.scales < 9)
    again = comparable & (distance.min(axis=1) < 1) & (distance.argmin(axis=0)[nearest] == np.arange(len(nearest)))
    assert again.sum() > 60
    assert again.sum() > 0.5 * comparable.sum()
    ratio = near.scales[again] / far.scales[nearest[again]]
    assert np.median(ratio) == pytest.approx(2, rel=0.15)
    assert (np.abs(np.log(ratio / 2)) < np.log(1.15)).mean() > 0.75
    assert (np.diff(near.strengths) <= 0).all()


@pytest.mark.parametrize("sigma", [3.0, 5.0])
def test_harris_laplace_measures_the_size_of_a_blob(sigma: float) -> None:
    """Test: one Gaussian blob. Expected: the strongest corner is its centre, and its scale the blob's sigma."""
    y, x = np.mgrid[:120, :160]
    blob = 30 + 200 * np.exp(-((x - 70) ** 2 + (y - 50) ** 2) / (2 * sigma**2))
    corners = harris_laplace(np.rint(blob).astype(np.uint8), min_response=2e-4)
    assert len(corners.points) > 0
    distance = np.linalg.norm(corners.points - [70, 50], axis=1)
    assert distance.min() <= 1.5
    assert np.log(corners.scales[distance.argmin()] / sigma) == pytest.approx(0, abs=np.log(1.3))
    flat = harris_laplace(np.full((60, 60), 9, np.uint8), min_response=2e-4)
    assert flat.points.shape == (0, 2) and flat.scales.shape == (0,)
