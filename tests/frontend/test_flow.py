"""Lucas-Kanade against images that are moved by known maps, against its description in numpy, and against OpenCV."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.frontend import flow
from seamark.frontend.kernels import native
from seamark.frontend.pyramid import Pyramid, pyramid_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
SETTINGS = {"window_px": 21, "levels": 3, "round_trip_px": 0.8, "min_correlation": 0.5}
SHIFT = np.array([6.4, -3.3])


def texture(seed: int, height: int = 240, width: int = 320) -> Image:
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    layers = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 5.0))
    return np.clip(128 + 90 * layers, 0, 255).astype(np.uint8)


def moved(image: Image, A: Array, t: Array) -> Image:
    """Return an image moved by x -> A x + t, every pixel interpolated exactly."""
    back = np.linalg.inv(A)
    x, y = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    source = (np.stack([x, y], -1) - t) @ back.T
    fine = cv2.resize(image.astype(np.float32), None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    at = ((source + 0.5) * 8 - 0.5).astype(np.float32)
    return np.clip(cv2.remap(fine, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), 0, 255).astype(np.uint8)


def grid(margin: float, step: float = 23.0, height: int = 240, width: int = 320) -> NDArray[np.float32]:
    x, y = np.meshgrid(np.arange(margin, width - margin, step), np.arange(margin, height - margin, step))
    return np.stack([x, y], -1).reshape(-1, 2).astype(np.float32) + np.float32(0.37)


# --- ground truth ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("A", "t", "light", "tolerance"),
    [
        (np.eye(2), SHIFT, (1.0, 0.0), 0.05),
        (np.eye(2), SHIFT, (0.9, 25.0), 0.06),
        (np.array([[0.99, -0.08], [0.08, 0.99]]), np.array([11.0, -13.0]), (1.0, 0.0), 0.3),
        (1.06 * np.eye(2), np.array([-9.0, -7.0]), (1.0, 0.0), 0.3),
    ],
)
def test_points_are_found_where_the_map_sends_them(
    A: Array, t: Array, light: tuple[float, float], tolerance: float
) -> None:
    """Test: shifts, a turn, growth, a change of light, noise. Expected: 95 % found, the median error within bounds."""
    image = texture(0)
    other = light[0] * moved(image, A, t) + light[1] + np.random.default_rng(1).normal(size=image.shape) * 2
    other = np.clip(other, 0, 255).astype(np.uint8)
    points = grid(45)
    true = points @ A.T + t
    there, ok = flow.track(pyramid_of(image, 3), pyramid_of(other, 3), points, None, **SETTINGS)
    assert ok.mean() > 0.95
    error = np.linalg.norm(there - true, axis=1)[ok]
    assert 0 < np.median(error) < tolerance
    assert np.percentile(error, 95) < 4 * tolerance


def test_a_guess_bridges_what_the_pyramid_cannot() -> None:
    image = texture(2)
    other = moved(image, np.eye(2), np.array([70.0, 0.0]))
    points = grid(30)[:30]
    points = points[points[:, 0] < 220]
    pair = pyramid_of(image, 0), pyramid_of(other, 0)
    settings = {**SETTINGS, "levels": 0}
    _, alone = flow.track(*pair, points, None, **settings)
    there, ok = flow.track(*pair, points, points + np.float32([68.5, 1]), **settings)
    assert alone.mean() < 0.2 < 0.9 < ok.mean()
    assert np.abs(there[ok] - points[ok] - [70, 0]).max() < 0.3


def test_what_is_beyond_the_border_does_not_pull() -> None:
    """Test: points 3 px from the border, whose patches are cut by it in both images. Expected: found like others."""
    image = texture(3)
    other = moved(image, np.eye(2), np.array([1.4, 1.2]))
    along = np.arange(20, 300, 9.0)
    points = np.vstack([np.column_stack([along, np.full_like(along, y)]) for y in (3, 234)]).astype(np.float32)
    there, ok = flow.track(pyramid_of(image, 3), pyramid_of(other, 3), points, None, **SETTINGS)
    error = np.linalg.norm(there - points - [1.4, 1.2], axis=1)
    assert ok.mean() > 0.9
    assert 0 < np.median(error[ok]) < 0.06
    leaves = np.array([[318.5, 100], [150, 238.5]], np.float32)
    _, ok = flow.track(pyramid_of(image, 3), pyramid_of(other, 3), leaves, None, **SETTINGS)
    assert not ok.any()


def test_another_patch_is_refused_by_its_correlation() -> None:
    """Test: half of the image is replaced. Expected: a third at most of the patches that return pass."""
    image, other = texture(4), texture(5)
    mixed = np.where(np.arange(320) < 160, image, other).astype(np.uint8)
    points = grid(14, 7.0)
    false = points[:, 0] > 175
    pair = pyramid_of(image, 3), pyramid_of(mixed, 3)
    _, loose = flow.track(*pair, points, None, **{**SETTINGS, "min_correlation": -1.0})
    _, strict = flow.track(*pair, points, None, **{**SETTINGS, "min_correlation": 0.8})
    assert loose[false].sum() > 40
    assert loose[false].sum() > 3 * strict[false].sum()
    assert strict[points[:, 0] < 145].all()


# --- the same in numpy, and OpenCV -------------------------------------------------------------------------------


def test_reduced_levels_are_those_of_opencv() -> None:
    for height, width in ((240, 320), (97, 131), (33, 64), (5, 9)):
        image = texture(6, height, width)
        pyramid = pyramid_of(image, 4)
        expected = image
        for level in range(pyramid.top + 1):
            np.testing.assert_array_equal(pyramid.level(level), expected)
            expected = cv2.pyrDown(expected)
        assert pyramid.top == 4 or min(expected.shape) < 16
        assert pyramid.grey.shape == image.shape


def sample(image: Array, x: Array, y: Array) -> Array:
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - left, y - top
    rows, columns = np.clip([top, top + 1], 0, image.shape[0] - 1), np.clip([left, left + 1], 0, image.shape[1] - 1)
    over = (1 - u) * image[rows[0], columns[0]] + u * image[rows[0], columns[1]]
    under = (1 - u) * image[rows[1], columns[0]] + u * image[rows[1], columns[1]]
    return (1 - v) * over + v * under


def step_in_numpy(before: Array, after: Array, point: Array, there: Array, half: int) -> tuple[Array, float]:
    """Return one Lucas-Kanade step and the correlation at ``there``, over the pixels that lie inside both images."""
    y, x = (d.ravel().astype(float) for d in np.mgrid[-half : half + 1, -half : half + 1])

    def inside(image: Array, at: Array, margin: int) -> NDArray[np.bool_]:
        left, top = np.floor(at[0]) + x, np.floor(at[1]) + y
        within = (left >= margin) & (left + 1 + margin <= image.shape[1] - 1)
        return within & (top >= margin) & (top + 1 + margin <= image.shape[0] - 1)

    use = inside(before, point, 1) & inside(after, there, 0)
    x, y = x[use], y[use]
    around = [[sample(before, point[0] + x + i, point[1] + y + j) for i in (-1, 0, 1)] for j in (-1, 0, 1)]
    a = np.array(around)
    slope_x = (3 * (a[0, 2] - a[0, 0] + a[2, 2] - a[2, 0]) + 10 * (a[1, 2] - a[1, 0])) / 32
    slope_y = (3 * (a[2, 0] - a[0, 0] + a[2, 2] - a[0, 2]) + 10 * (a[2, 1] - a[0, 1])) / 32
    J = np.column_stack([slope_x - slope_x.mean(), slope_y - slope_y.mean()])
    seen = sample(after, there[0] + x, there[1] + y)
    return -np.linalg.solve(J.T @ J, J.T @ (seen - a[1, 1])), float(np.corrcoef(seen, a[1, 1])[0, 1])


def find_in_numpy(before: Pyramid, after: Pyramid, point: Array, guess: Array, top: int) -> tuple[Array, float]:
    there, likeness = guess.astype(float), 0.0
    for level in range(top, -1, -1):
        images = before.level(level).astype(float), after.level(level).astype(float)
        for _ in range(12):
            step, likeness = step_in_numpy(*images, point / 2**level, there / 2**level, 10)
            there = there + step * 2**level
    return there, likeness


def test_points_go_where_numpy_says() -> None:
    """Test: no early end, exact numbers. Expected: 0.02 px and 0.01 of correlation beside it; at the border too."""
    image = texture(7)
    other = moved(image, np.array([[1.02, -0.03], [0.03, 1.02]]), np.array([2.0, -6.0]))
    other = np.clip(other + np.random.default_rng(1).normal(size=other.shape) * 2, 0, 255).astype(np.uint8)
    points = np.vstack([grid(30, 53.0), [[4.2, 100.6], [310.3, 60.1], [160.0, 9.0]]]).astype(np.float32)
    pair = pyramid_of(image, 2), pyramid_of(other, 2)
    there, round_trip, likeness = native.follow(*pair, points, points, 21, 2, 1)
    held = round_trip < 0.8
    assert held.mean() > 0.9 and held[-3:].sum() >= 2
    for i in np.flatnonzero(held):
        expected, expected_likeness = find_in_numpy(*pair, points[i], points[i], 2)
        assert np.linalg.norm(there[i] - expected) < 0.02
        assert likeness[i] == pytest.approx(expected_likeness, abs=0.01)
        back, _ = find_in_numpy(pair[1], pair[0], there[i], points[i], 1)
        assert round_trip[i] == pytest.approx(np.linalg.norm(back - points[i]), abs=0.1)


def test_what_would_be_refused_is_not_searched_to_its_end() -> None:
    """Test: half of the image is another; a least likeness, a reach. Expected: what is unlike is not followed back and
    nothing else changes; what is farther than the reach is lost, what is nearer is where it was found without one.
    """
    image = texture(10)
    other = moved(image, np.eye(2), SHIFT)
    other[:, 160:] = texture(11)[:, 160:]
    points = grid(30)
    pair = pyramid_of(image, 2), pyramid_of(other, 2)
    there, round_trip, likeness = native.follow(*pair, points, points, 21, 2, 1)
    some = native.follow(*pair, points, points, 21, 2, 1, least_likeness=0.5)
    unlike = likeness < 0.5
    assert 0.3 < unlike.mean() < 0.7 and (likeness[unlike] != 0).any()
    np.testing.assert_array_equal(some[0], there)
    np.testing.assert_array_equal(some[1], np.where(unlike, np.inf, round_trip))

    length = float(np.linalg.norm(SHIFT))
    for reach, found in ((length - 1, False), (length + 3, True)):
        at, back, _ = native.follow(*pair, points, points, 21, 0, 0, reach=reach)
        free, back_free, _ = native.follow(*pair, points, points, 21, 0, 0)
        left = (points[:, 0] < 130) & (np.linalg.norm(free - points - SHIFT, axis=1) < 0.2) & (back_free < 0.2)
        assert left.sum() > 20
        assert (np.linalg.norm(at - points, axis=1) <= reach + 0.01).all()
        assert np.isfinite(back[left]).mean() == pytest.approx(float(found), abs=0.1)
        same = np.isfinite(back) & left
        np.testing.assert_array_equal(at[same], free[same])


def test_points_go_where_opencv_sends_them() -> None:
    image = texture(8)
    other = moved(image, np.eye(2), SHIFT)
    points = grid(45)
    there, ok = flow.track(pyramid_of(image, 3), pyramid_of(other, 3), points, None, **SETTINGS)
    theirs, found, _ = cv2.calcOpticalFlowPyrLK(image, other, points, None, winSize=(21, 21), maxLevel=3)
    both = ok & (found.ravel() == 1)
    assert both.mean() > 0.95
    assert np.percentile(np.linalg.norm(there - theirs, axis=1)[both], 95) < 0.05


def test_every_level_of_the_processor_gives_the_same_bits() -> None:
    image = texture(9)
    pair = pyramid_of(image, 3), pyramid_of(moved(image, 1.05 * np.eye(2), -SHIFT), 3)
    points = np.random.default_rng(0).uniform((0, 0), (319, 239), (300, 2)).astype(np.float32)
    for side in (5, 21, 29):
        results = [native.follow(*pair, points, points, side, 3, 1, level) for level in native.levels()]
        assert native.levels()[0] == "baseline"
        for other in (*results[1:], native.follow(*pair, points, points, side, 3, 1)):
            assert all(a.tobytes() == b.tobytes() for a, b in zip(results[0], other, strict=True))


# --- hostile input -----------------------------------------------------------------------------------------------


def test_points_that_are_nowhere_are_lost() -> None:
    image = texture(10)
    ready = pyramid_of(image, 3)
    nan, far = np.nan, 1e30
    points = np.array([[nan, 5], [5, nan], [far, 9], [-far, 9], [np.inf, 0], [-1, 50], [50, 240], [60, 60]], np.float32)
    there, ok = flow.track(ready, ready, points, None, **SETTINGS)
    assert ok.tolist() == [False] * 7 + [True]
    start = np.tile(np.array([[60.0, 60.0]], np.float32), (8, 1))
    there, ok = flow.track(ready, ready, start, points, **SETTINGS)
    assert ok.tolist() == [False] * 7 + [True]
    assert np.linalg.norm(there[-1] - start[-1]) < 0.01
    there, ok = flow.track(ready, ready, points[:0], None, **SETTINGS)
    assert there.shape == (0, 2) and ok.shape == (0,)


def test_images_without_anything_or_of_few_pixels_hold_nothing() -> None:
    points = np.array([[1, 1], [0, 0], [2, 0]], np.float32)
    for shape in ((1, 1), (1, 40), (3, 3), (12, 9)):
        small = pyramid_of(texture(11, 16, 40)[: shape[0], : shape[1]], 4)
        there, ok = flow.track(small, small, points, None, **SETTINGS)
        assert not ok[points[:, 0] >= shape[1]].any()
        assert np.isfinite(there).all()
    for value in (0, 255):
        flat = pyramid_of(np.full((120, 160), value, np.uint8), 4)
        assert not flow.track(flat, flat, grid(20, 23.0, 120, 160), None, **SETTINGS)[1].any()
    stripes = pyramid_of(np.tile(np.uint8([0, 255] * 80), (120, 1)), 4)  # held in one direction only
    assert not flow.track(stripes, stripes, grid(20, 23.0, 120, 160), None, **SETTINGS)[1].any()
    checks = 255 * (np.indices((120, 160)).sum(axis=0) // 2 % 2).astype(np.uint8)  # the largest sums there are
    there, ok = flow.track(*(pyramid_of(image, 4) for image in (checks, 255 - checks)), grid(20), None, **SETTINGS)
    assert np.isfinite(there).all()


def test_images_of_other_sizes_and_kinds() -> None:
    """Test: a smaller second image. Expected: what is outside of it is lost. Wrong types and shapes are refused."""
    image = texture(12)
    points = grid(20)
    _, ok = flow.track(pyramid_of(image, 3), pyramid_of(image[:, :160], 3), points, None, **SETTINGS)
    assert ok[points[:, 0] < 140].all() and not ok[points[:, 0] > 165].any()
    for wrong in (image.astype(np.float32), image[None], image.astype(np.uint16)):
        with pytest.raises(TypeError):
            pyramid_of(wrong, 3)
    with pytest.raises(ValueError, match="pixels"):
        pyramid_of(image[:0], 3)
    ready = pyramid_of(image, 3)
    with pytest.raises(ValueError, match="level"):
        native.follow(ready, ready, points, points, 21, 3, 1, "abacus")
    with pytest.raises(ValueError, match="start"):
        native.follow(ready, ready, points, points[1:], 21, 3, 1)
    with pytest.raises(ValueError, match="side"):
        native.follow(ready, ready, points, points, 31, 3, 1)
