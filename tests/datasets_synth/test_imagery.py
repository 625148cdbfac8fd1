"""Generated pictures: every one different, none empty, the same from the same seed."""

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import fittings, outdoors, plain, prints, shading, textures
from seamark.datasets_synth.imagery import training_images


def test_training_images_are_varied_and_full_of_features() -> None:
    images = list(training_images(2, 8, (320, 240)))
    assert len(images) == 8
    sift = cv2.SIFT_create(1000)
    counts = [len(sift.detect(image, None)) for image in images]
    assert np.median(counts) > 200
    for image in images:
        assert image.shape == (240, 320, 3)
        assert image.dtype == np.uint8
        assert 15 < image.mean() < 240
    differences = [np.abs(a.astype(int) - b).mean() for a in images for b in images if a is not b]
    assert min(differences) > 10


def test_image_depends_on_seed_and_index_only() -> None:
    few, more = list(training_images(4, 2, (160, 120))), list(training_images(4, 3, (160, 120)))
    assert few[1].tobytes() == more[1].tobytes()
    assert next(training_images(5, 1, (160, 120))).tobytes() != few[0].tobytes()


@pytest.mark.parametrize("surface", [*textures.WALLS, textures.carpet])
def test_surfaces_have_texture_at_every_scale(surface: textures.Surface) -> None:
    for pixels_per_metre in (40.0, 160.0):
        image = surface(np.random.default_rng(1), 150, 210, pixels_per_metre)
        assert image.shape == (150, 210, 3)
        assert 30 < image.mean() < 235
        assert 6 < cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).std() < 90


def test_no_two_posters_are_alike() -> None:
    rng = np.random.default_rng(0)
    posters = [prints.poster(rng, 120, 90).astype(int) for _ in range(6)]
    assert min(np.abs(a - b).mean() for a in posters for b in posters if a is not b) > 20


def test_small_sizes_do_not_fail() -> None:
    makers = (prints.poster, prints.shelf, prints.carton, outdoors.facade, outdoors.foliage, outdoors.grass)
    more = (fittings.radiator, fittings.notice_board, fittings.whiteboard, fittings.door_leaf)
    for maker in (*makers, *more):
        assert maker(np.random.default_rng(3), 40, 30).shape == (40, 30, 3)


def _points(image: np.ndarray) -> float:
    """Return SIFT points per 10000 px."""
    return len(cv2.SIFT_create().detect(image, None)) / image[..., 0].size * 1e4


def test_plain_surfaces_give_little_and_wear_takes_away() -> None:
    rng = np.random.default_rng(4)
    brick = textures.brick(rng, 300, 400, 150.0)
    worn = plain.worn(rng, brick, 150.0, (0.5, 0.5))
    assert 0.35 < worn.std() / brick.std() < 0.75
    for image in (
        plain.painted(rng, 300, 400, 150.0, plain.paint(rng)),
        plain.linoleum(rng, 300, 400, 110.0),
        plain.ceiling(rng, 300, 400, 110.0),
    ):
        assert image.shape == (300, 400, 3)
        assert image.flags.c_contiguous
        assert _points(image) < 0.5 * _points(brick)
        assert 2 < image.std() < 45


def test_corners_and_floors_under_things_are_dark() -> None:
    shade = shading.edges(200, 300, 100.0, (1.0, 0.0, 0.0, shading.along(200, 100.0, [(1.2, 2.0)])))
    assert 0.99 < shade[150, 290] <= 1
    assert 0.6 < shade[0, 150] < 0.7 < shade[10, 150] < shade[40, 150] < 1
    assert shade[60, 0] < 0.75 < 0.99 < shade[180, 0]  # an open side is not a corner
    square = np.array([[100, 80], [160, 80], [160, 140], [100, 140]], float)
    under = shading.contact(200, 300, 100.0, [square])
    assert 0.35 < under[110, 130] < 0.6 < under[110, 165] < 0.95 < under[20, 20]
    grey = np.full((200, 300, 3), 200, np.uint8)
    assert np.array_equal(shading.shaded(grey, shade)[..., 0], np.rint(200 * shade).astype(np.uint8))


def test_windows_of_a_front_repeat() -> None:
    shares = []
    for seed in range(4):
        image = fittings.front(np.random.default_rng(seed), 500, 600, 55.0)
        assert image.shape == (500, 600, 3)
        _, descriptors = cv2.SIFT_create(1000).detectAndCompute(image, None)
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, descriptors, 2)
        shares.append(float(np.mean([second.distance < 120 for _, second in pairs])))
    assert 0.15 < max(shares) < 0.9  # rendered fronts
    assert min(shares) > 0.01
