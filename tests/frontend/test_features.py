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
