"""Histograms and the Jeffrey divergence: known values, properties, missing channels."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seamark.vocab.errors import ObservationError
from seamark.vocab.histogram import (
    CHANNELS,
    HUE,
    LIGHTNESS,
    MAX_DIVERGENCE,
    Histograms,
    describe,
    divergence_to_all,
    jeffrey_divergence,
    smoothing_matrix,
)

counts = st.lists(st.integers(0, 1000), min_size=8, max_size=8).filter(lambda values: sum(values) > 0)


def distribution(values: list[int]) -> np.ndarray:
    return (np.array(values) / sum(values)).astype(np.float32)


def by_definition(p: np.ndarray, q: np.ndarray) -> float:
    total = 0.0
    for a, b in zip(p.tolist(), q.tolist(), strict=True):
        middle = (a + b) / 2
        total += a * math.log(a / middle) if a > 0 else 0.0
        total += b * math.log(b / middle) if b > 0 else 0.0
    return total


@given(first=counts, second=counts)
@settings(max_examples=200, deadline=None)
def test_divergence_is_symmetric_finite_and_as_defined(first: list[int], second: list[int]) -> None:
    p, q = distribution(first), distribution(second)
    value = float(jeffrey_divergence(p, q))
    assert value == float(jeffrey_divergence(q, p))
    assert 0 <= value <= MAX_DIVERGENCE * (1 + 1e-6)
    assert value == pytest.approx(by_definition(p, q), abs=2e-6)
    assert float(jeffrey_divergence(p, p)) == 0


def test_known_divergences() -> None:
    p, q = np.array([1, 0], np.float32), np.array([0, 1], np.float32)
    assert float(jeffrey_divergence(p, q)) == pytest.approx(2 * math.log(2), rel=1e-6)
    half = np.array([0.5, 0.5], np.float32)
    assert float(jeffrey_divergence(p, half)) == pytest.approx(1.5 * math.log(4 / 3), rel=1e-6)
    tiny = np.array([1e-40, 1], np.float32)  # smaller than the smallest normal float
    assert np.isfinite(jeffrey_divergence(tiny, q)) and float(jeffrey_divergence(tiny, q)) < 1e-6


def test_smoothing_keeps_mass_and_only_hue_wraps() -> None:
    straight = smoothing_matrix(32, 1.5, circular=False)
    wrapped = smoothing_matrix(32, 1.5, circular=True)
    for matrix in (straight, wrapped):
        np.testing.assert_allclose(matrix.sum(axis=1), 1)
    assert straight[0, 31] == 0 and wrapped[0, 31] == pytest.approx(wrapped[0, 1])
    np.testing.assert_allclose(wrapped[5], np.roll(wrapped[0], 5))
    assert straight[10, 12] / straight[10, 10] == pytest.approx(math.exp(-0.5 * (2 / 1.5) ** 2))
    np.testing.assert_array_equal(smoothing_matrix(8, 0.0, circular=True), np.eye(8))


def test_channels_of_a_known_image() -> None:
    """Half pure red, half pure blue: counts by hand, no smoothing."""
    image = np.zeros((4, 6, 3), np.uint8)
    image[:, :3, 2] = 255
    image[:, 3:, 0] = 255
    histograms = describe(image, 4, 0.0)
    assert histograms.present.all() and histograms.values.dtype == np.float32
    rows = dict(zip(CHANNELS, histograms.values, strict=True))
    np.testing.assert_allclose(rows["r"], [0.5, 0, 0, 0.5])
    np.testing.assert_allclose(rows["g"], [1, 0, 0, 0])
    np.testing.assert_allclose(rows["b"], [0.5, 0, 0, 0.5])
    np.testing.assert_allclose(rows["h"], [0.5, 0, 0.5, 0])  # red 0 degrees, blue 240
    np.testing.assert_allclose(rows["s"], [0, 0, 0, 1])
    np.testing.assert_allclose(rows["l"], [0.5, 0.5, 0, 0])  # luma 29 and 76


def test_reds_on_both_sides_of_zero_hue_are_alike() -> None:
    def red(blue: int, green: int) -> Histograms:
        return describe(np.full((5, 5, 3), (blue, green, 250), np.uint8), 32, 1.0)

    warm, cold, green = red(0, 12), red(12, 0), describe(np.full((5, 5, 3), (0, 250, 12), np.uint8), 32, 1.0)
    near = float(jeffrey_divergence(warm.values[HUE], cold.values[HUE]))
    far = float(jeffrey_divergence(warm.values[HUE], green.values[HUE]))
    assert 0 < near < 0.4 and far == pytest.approx(MAX_DIVERGENCE, rel=1e-5)


def test_grey_pixels_have_no_say_in_hue() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (20, 20, 3), dtype=np.uint8)
    greyer = np.concatenate([image, np.full((20, 20, 3), 90, np.uint8)])
    np.testing.assert_allclose(describe(greyer, 16, 1.0).values[HUE], describe(image, 16, 1.0).values[HUE], atol=1e-7)


@pytest.mark.parametrize("shape", [(9, 12), (9, 12, 3)])
def test_images_without_colour_have_lightness_only(shape: tuple[int, ...]) -> None:
    plane = np.random.default_rng(1).integers(0, 256, (9, 12), dtype=np.uint8)
    image = plane if len(shape) == 2 else np.repeat(plane[..., None], 3, axis=2)
    histograms = describe(image, 32, 1.0)
    assert histograms.present.tolist() == [channel == "l" for channel in CHANNELS]
    np.testing.assert_array_equal(histograms.values, describe(plane, 32, 1.0).values)
    assert not histograms.values[:LIGHTNESS].any()


def test_black_and_white_images_stay_finite() -> None:
    for value in (0, 255):
        for image in (np.full((3, 3), value, np.uint8), np.full((3, 3, 3), value, np.uint8)):
            histograms = describe(image, 32, 1.0)
            assert histograms.values[LIGHTNESS].sum() == pytest.approx(1, abs=1e-6)


def test_one_to_all_is_the_mean_over_common_channels() -> None:
    rng = np.random.default_rng(2)
    images = [rng.integers(0, 200, (8, 8, 3), dtype=np.uint8) for _ in range(4)]
    images += [rng.integers(0, 200, (8, 8), dtype=np.uint8) for _ in range(3)]
    described = [describe(image, 16, 1.0) for image in images]
    values = np.stack([h.values for h in described])
    present = np.stack([h.present for h in described])
    for query in described:
        result = divergence_to_all(query, values, present)
        assert result.dtype == np.float32
        for other, value in zip(described, result, strict=True):
            common = [c for c in range(6) if query.present[c] and other.present[c]]
            expected = np.mean([by_definition(query.values[c], other.values[c]) for c in common])
            assert value == pytest.approx(expected, abs=2e-6)
            assert len(common) in (1, 6)


def test_one_to_all_of_none() -> None:
    query = describe(np.zeros((3, 3), np.uint8), 16, 1.0)
    assert divergence_to_all(query, np.zeros((0, 6, 16), np.float32), np.zeros((0, 6), bool)).shape == (0,)


@pytest.mark.parametrize(
    "thumbnail",
    [
        np.zeros((3, 3), np.float32),
        np.zeros((0, 3), np.uint8),
        np.zeros((3, 3, 4), np.uint8),
        np.zeros((3, 3, 1), np.uint8),
        np.zeros(9, np.uint8),
    ],
)
def test_other_arrays_are_refused(thumbnail: np.ndarray) -> None:
    with pytest.raises(ObservationError, match="thumbnail"):
        describe(thumbnail, 32, 1.0)
