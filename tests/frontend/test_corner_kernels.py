"""The loops under the corners, against OpenCV's responses and numpy."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.frontend.corners import HARRIS_K, away_from
from seamark.frontend.kernels import native
from seamark.frontend.pyramid import pyramid_of

RNG = np.random.default_rng(3)


def texture(height: int, width: int) -> NDArray[np.uint8]:
    noise = RNG.normal(size=(height, width)).astype(np.float32)
    return np.clip(128 + 200 * cv2.GaussianBlur(noise, (0, 0), 1.5), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("harris_k", [0.0, HARRIS_K])
@pytest.mark.parametrize(("height", "width", "cell"), [(120, 163, 27), (97, 80, 9), (64, 64, 64)])
def test_the_strongest_of_each_cell_is_that_of_opencv(height: int, width: int, cell: int, harris_k: float) -> None:
    image, mask = texture(height, width), np.full((height, width), 255, np.uint8)
    mask[30:50, 20:60] = 0
    as_float = image.astype(np.float32) / 255
    response = cv2.cornerHarris(as_float, 5, 3, harris_k) if harris_k else cv2.cornerMinEigenVal(as_float, 5, ksize=3)
    response[:8] = response[-8:] = response[:, :8] = response[:, -8:] = 0
    response[mask == 0] = 0
    pixels, strength = native.strongest(image, cell, 8, harris_k, mask)
    assert len(pixels) == (height // cell) * (width // cell)
    n = 0
    for row in range(height // cell):
        for column in range(width // cell):
            part = response[row * cell : (row + 1) * cell, column * cell : (column + 1) * cell]
            assert strength[n] == pytest.approx(max(part.max(), 0), rel=1e-5, abs=1e-9)
            if part.max() > 0:
                y, x = np.unravel_index(part.argmax(), part.shape)
                assert pixels[n].tolist() == [column * cell + x, row * cell + y]
            n += 1


def test_a_view_of_a_pyramid_and_a_tiny_image_are_taken() -> None:
    image = texture(100, 140)
    for a, b in zip(
        native.strongest(image, 20, 8, 0.0, None),
        native.strongest(pyramid_of(image, 2).grey, 20, 8, 0.0, None),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    assert native.strongest(image[:16, :16].copy(), 16, 8, 0.0, None)[1].tolist() == [0]
    assert len(native.strongest(image[:3, :3].copy(), 16, 8, 0.0, None)[1]) == 0
    with pytest.raises(ValueError, match="mask"):
        native.strongest(image, 20, 8, 0.0, np.zeros((100, 141), np.uint8))
    with pytest.raises(ValueError, match="side by side"):
        native.strongest(image[:, ::2], 20, 8, 0.0, None)
    with pytest.raises(TypeError):
        native.strongest(image.astype(np.float32), 20, 8, 0.0, None)


def test_the_median_difference_is_that_of_the_filter() -> None:
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    for shape in ((60, 81), (61, 80), (7, 4)):
        image = RNG.integers(0, 256, shape, dtype=np.uint8)
        filtered = cv2.filter2D(image.astype(np.float32), cv2.CV_32F, kernel)[1:-1:3, 1:-1:3]
        assert native.median_difference(image) == np.median(np.abs(filtered))
    assert native.median_difference(np.zeros((2, 9), np.uint8)) == 0


def test_points_that_are_apart() -> None:
    points = RNG.uniform(0, 100, (80, 2)).astype(np.float32)
    others = RNG.uniform(0, 100, (30, 2)).astype(np.float32)
    strength = RNG.uniform(size=80).astype(np.float32)
    strength[10:20] = strength[10]
    kept = away_from(points, strength, others, 6.0)
    order = np.argsort(-strength, kind="stable")
    expected = [
        points[k]
        for i, k in enumerate(order)
        if np.linalg.norm(np.vstack([others, points[order[:i]]]) - points[k], axis=1).min() >= 6
    ]
    np.testing.assert_array_equal(kept, expected)
    assert 5 < len(kept) < 60
    assert native.apart(points, others[:0], 6.0, to_each_other=False).all()
    assert len(native.apart(points[:0], others, 6.0, to_each_other=True)) == 0
