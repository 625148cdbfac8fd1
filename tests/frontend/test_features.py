"""Descriptors and their matching against an independent computation; corners and flow against a known shift."""

import cv2
import numpy as np
import pytest

from seamark.frontend.corners import detect_corners
from seamark.frontend.features import extract_features, grey_of, match_descriptors, root_sift, thumbnail_of


def textured(height: int = 240, width: int = 320) -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 255, (height, width)).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.5).astype(float)
    return np.clip((blurred - blurred.mean()) * 6 + 128, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("both_ways", [False, True])
@pytest.mark.parametrize(("n", "m"), [(60, 80), (2, 2), (1, 30), (30, 0)])
def test_matches_are_those_of_a_plain_search(n: int, m: int, both_ways: bool) -> None:
    rng = np.random.default_rng(n)
    b = rng.integers(0, 256, (m, 128)).astype(np.uint8)
    a = rng.integers(0, 256, (n, 128)).astype(np.uint8)
    shared = min(n, m) // 2
    a[:shared] = np.clip(b[:shared].astype(int) + rng.integers(-30, 31, (shared, 128)), 0, 255)
    a[: shared // 2] = a[0]  # many that look the same: distinct from a to b, ambiguous from b to a
    expected = []
    if min(n, m) >= 2:
        distance = np.linalg.norm(a[:, None].astype(float) - b[None], axis=2)
        for i in range(n):
            j = int(distance[i].argmin())
            distinct = distance[i, j] < 0.8 * np.sort(distance[i])[1]
            back = distance[i, j] < 0.8 * np.sort(distance[:, j])[1]
            if int(distance[:, j].argmin()) == i and distinct and (back or not both_ways):
                expected.append((i, j))
    found = match_descriptors(a, b, ratio=0.8, both_ways=both_ways)
    assert found.shape == (len(expected), 2)
    assert [tuple(pair) for pair in found.tolist()] == expected
    if n == 60:
        assert len(expected) == (15 if both_ways else 16)


def test_root_sift_compares_as_hellinger() -> None:
    """Expected: the distance of uint8 descriptors is 512 times Hellinger's of the L1-normalised histograms."""
    histograms = np.random.default_rng(1).gamma(0.6, 40, (2, 128)).astype(np.float32)
    p, q = (h / h.sum() for h in histograms.astype(float))
    expected = 512 * np.linalg.norm(np.sqrt(p) - np.sqrt(q))
    a, b = root_sift(histograms).astype(float)
    assert np.linalg.norm(a - b) == pytest.approx(expected, rel=0.02)
    assert root_sift(np.zeros((1, 128), np.float32)).max() == 0


def test_features_are_bounded_strong_first_and_the_same_in_colour() -> None:
    image = textured()
    few, many = extract_features(image, 50), extract_features(image, 200)
    assert len(few) == 50
    assert 100 < len(many) <= 200
    np.testing.assert_array_equal(few.points, many.points[:50])
    colour = extract_features(np.dstack([image] * 3), 50)
    np.testing.assert_array_equal(colour.points, few.points)
    assert len(extract_features(np.full((200, 200), 90, np.uint8), 50)) == 0


def test_thumbnails_keep_their_shape_and_are_never_enlarged() -> None:
    assert thumbnail_of(textured(100, 400), 96).shape == (24, 96)
    assert thumbnail_of(np.zeros((2, 900, 3), np.uint8), 90).shape == (1, 90, 3)
    np.testing.assert_array_equal(thumbnail_of(textured(30, 40), 96), textured(30, 40))


@pytest.mark.parametrize("harris", [False, True])
def test_corners_are_spread_and_keep_away_from_occupied_cells(harris: bool) -> None:
    image = textured()
    corners = detect_corners(image, np.zeros((0, 2)), 200, harris=harris, min_response=2e-5)
    assert 100 < len(corners) < 220
    assert (corners > 4).all()
    assert (corners < [320 - 5, 240 - 5]).all()
    quarters = np.bincount((corners[:, 0] > 160) + 2 * (corners[:, 1] > 120), minlength=4)
    assert quarters.min() > 0.15 * len(corners)
    again = detect_corners(image, corners, 200, harris=harris, min_response=2e-5)
    assert len(again) < 0.35 * len(corners)
    gaps = np.linalg.norm(again[:, None] - corners[None], axis=2) if len(again) else np.full((1, 1), np.inf)
    assert gaps.min() > 3
    assert len(detect_corners(np.full_like(image, 7), np.zeros((0, 2)), 200, harris=harris, min_response=2e-5)) == 0


def test_grey_is_the_image_itself_where_it_is_grey() -> None:
    image = textured(20, 30)
    assert grey_of(image) is image
    assert grey_of(np.zeros((4, 5, 3), np.uint8)).shape == (4, 5)


def test_features_of_a_reduced_image_lie_where_those_of_the_whole_one_do() -> None:
    """Test: SIFT on a third of the pixels, of an odd size, under a mask. Expected: no bias of points and scales."""
    image = cv2.resize(textured(), (801, 603), interpolation=cv2.INTER_CUBIC)
    mask = np.full(image.shape, 255, np.uint8)
    mask[:, 500:] = 0
    whole = extract_features(image, 1500, mask=mask)
    reduced = extract_features(image, 500, mask=mask, max_pixels=160_000)
    assert len(reduced) > 150
    pairs = match_descriptors(reduced.descriptors, whole.descriptors)
    offset = reduced.points[pairs[:, 0]] - whole.points[pairs[:, 1]]
    near = np.linalg.norm(offset, axis=1) < 3
    assert near.sum() > 60 and near.mean() > 0.8
    assert np.abs(np.median(offset[near], axis=0)).max() < 0.1
    assert np.median(reduced.scales[pairs[near, 0]] / whole.scales[pairs[near, 1]]) == pytest.approx(1, abs=0.1)
    assert reduced.points[:, 0].max() < 503
    same = extract_features(image, 500, mask=mask, max_pixels=image.size)
    np.testing.assert_array_equal(same.points, extract_features(image, 500, mask=mask).points)


def blobs() -> np.ndarray:
    """Return bright and dark spots, bars and noise of many sizes."""
    rng = np.random.default_rng(4)
    image = np.full((260, 372), 120.0)
    for _ in range(220):
        centre, axes = tuple(rng.integers(0, (372, 260)).tolist()), tuple(rng.integers(2, 22, 2).tolist())
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(20, 235)), -1)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("image", [blobs(), textured(301, 203)], ids=["blobs", "texture"])
def test_key_points_are_those_of_opencv(image: np.ndarray) -> None:
    """Test: OpenCV's SIFT of the same image. Expected: the same key points but for a few at the thresholds, in the same
    places, with the same descriptors but for rounding.
    """
    theirs, their_descriptors = cv2.SIFT_create(
        5000, contrastThreshold=0.015, enable_precise_upscale=True
    ).detectAndCompute(image, None)
    expected = np.array([(*k.pt, np.log(k.size), k.angle) for k in theirs])
    own = extract_features(image, 5000)
    found = np.column_stack([own.points, np.log(own.scales), np.rad2deg(own.angles)])
    assert len(found) == pytest.approx(len(expected), rel=0.003)
    apart = np.abs(found[:, None] - expected[None])
    apart[..., 3] = np.minimum(apart[..., 3], 360 - apart[..., 3])
    same = (apart < (0.02, 0.02, 0.01, 1.0)).all(axis=2)
    assert same.any(axis=1).mean() > 0.97
    mine = np.flatnonzero(same.any(axis=1))
    difference = np.linalg.norm(
        own.descriptors[mine].astype(float) - root_sift(their_descriptors[same[mine].argmax(axis=1)]).astype(float),
        axis=1,
    )
    assert np.median(difference) < 2
    assert np.percentile(difference, 95) < 10


@pytest.mark.parametrize("shape", [(1, 1), (7, 300), (300, 7), (8, 8), (33, 17)])
def test_key_points_of_small_images(shape: tuple[int, int]) -> None:
    """Expected: what there is lies inside, and an image too small for the scale space has nothing."""
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    points = extract_features(image, 100).points
    assert ((points >= 0) & (points <= np.array(shape[::-1]) - 1)).all()
    assert len(points) == 0 or min(shape) >= 8


def test_key_points_of_a_part_of_an_image_are_found_again() -> None:
    """Test: a view whose rows lie apart in memory. Expected: the same as of a copy."""
    part = textured()[20:200, 30:290]
    np.testing.assert_array_equal(
        extract_features(part, 300).descriptors, extract_features(part.copy(), 300).descriptors
    )
