"""Generated pictures: every one different, none empty, the same from the same seed."""

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import outdoors, prints, textures
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
    for maker in (prints.poster, prints.shelf, prints.carton, outdoors.facade, outdoors.foliage, outdoors.grass):
        assert maker(np.random.default_rng(3), 40, 30).shape == (40, 30, 3)
