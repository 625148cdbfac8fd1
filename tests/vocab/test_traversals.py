"""What all images of a traversal have in common: taken off, whatever the order, and colours that differ as a whole."""

import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.vocab import histogram, traversals
from seamark.vocab.config import VocabConfig
from seamark.vocab.view import COLUMNS, NO_CELLS, ORIENTATIONS, ROWS, SHIFTS

N = 40


def places_and_common(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    places = rng.normal(0, 12, (N, ROWS, COLUMNS, ORIENTATIONS))
    common = rng.normal(0, 40, (2, ROWS, COLUMNS, ORIENTATIONS))
    return places, common


def as_cells(values: NDArray[np.float64]) -> NDArray[np.int8]:
    return np.clip(np.rint(values), -127, 127).astype(np.int8)


def test_what_two_conditions_share_no_longer_hides_the_places() -> None:
    """Marks of the camera three times as strong as what tells places apart, others by night than by day."""
    places, (day, night) = places_and_common(1)
    noise = np.random.default_rng(2).normal(0, 6, places.shape)
    likeness = traversals.view_likeness(as_cells(places + noise + night), as_cells(places + day))
    assert likeness.shape == (N, N) and likeness.dtype == np.float32
    assert (likeness.argmax(axis=1) == np.arange(N)).all()
    by_night, by_day = (as_cells(x).reshape(N, -1) for x in (places + noise + night, places + day))
    as_they_are = np.corrcoef(by_night, by_day)[:N, N:]

    def lead(of: NDArray[np.floating]) -> float:
        """By how much the right place leads, in the worst case."""
        return min(float(of[i, i] - np.delete(of[i], i).max()) for i in range(N))

    assert lead(as_they_are) < 0.1
    assert lead(likeness) > 0.15
    assert likeness.min() >= 0 and 0.25 < np.diag(likeness).mean() < 1


def test_a_shifted_view_is_found_and_equals_the_correlation_of_what_both_show() -> None:
    places, (day, night) = places_and_common(3)
    ours, theirs = as_cells(places[:, :, ::-1] + night), as_cells(places + day)
    prior = np.zeros(ORIENTATIONS)
    prior[: ORIENTATIONS // 2] = theirs[..., : ORIENTATIONS // 2].mean(dtype=np.float64)
    weight = traversals.PRIOR_IMAGES
    mean = (theirs.sum(axis=0, dtype=float) + weight * prior) / (N + weight)
    mean_ours = (ours.sum(axis=0, dtype=float) + weight * mean) / (N + weight)
    a, b = ours[7] - mean_ours, theirs[4] - mean
    expected = 0.0
    for shift in SHIFTS:
        one = np.stack([a[:, x] for x in range(COLUMNS) if 0 <= x - shift < COLUMNS])
        other = np.stack([b[:, x - shift] for x in range(COLUMNS) if 0 <= x - shift < COLUMNS])
        expected = max(expected, float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())))
    assert traversals.view_likeness(ours, theirs)[7, 4] == pytest.approx(expected, abs=1e-5)
    moved = np.roll(places, 2, axis=2)
    found = traversals.view_likeness(as_cells(moved + night), as_cells(places + day))
    assert (found.argmax(axis=1) == np.arange(N)).all()


def test_the_order_of_images_does_not_matter() -> None:
    places, (day, night) = places_and_common(4)
    ours, theirs = as_cells(places + night), as_cells(places + day)
    random = np.random.default_rng(5)
    rows, columns = random.permutation(N), random.permutation(N)
    straight = traversals.view_likeness(ours, theirs)
    np.testing.assert_allclose(
        traversals.view_likeness(ours[rows], theirs[columns]), straight[rows][:, columns], atol=1e-6
    )


def test_a_single_query_is_compared_as_it_is() -> None:
    """One image says nothing of what its traversal has in common: it may not be taken off itself."""
    places, (day, _) = places_and_common(6)
    theirs = as_cells(places + day)
    likeness = traversals.view_likeness(theirs[11:12], theirs)
    assert likeness.argmax() == 11 and likeness.max() > 0.99
    assert traversals.view_likeness(theirs[:1], theirs[:1])[0, 0] > 0.99


def test_nothing_is_like_nothing() -> None:
    cells = as_cells(places_and_common(7)[0])
    assert traversals.view_likeness(NO_CELLS, cells).shape == (0, N)
    assert traversals.view_likeness(cells, NO_CELLS).shape == (N, 0)
    flat = np.zeros((3, ROWS, COLUMNS, ORIENTATIONS), np.int8)
    assert np.isfinite(traversals.view_likeness(flat, flat)).all()


def histograms_of(level: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found = [
        histogram.describe(np.random.default_rng(i).normal(value, 20, (30, 40)).clip(0, 255).astype(np.uint8), 32, 1.0)
        for i, value in enumerate(level)
    ]
    return np.stack([one.values for one in found]), np.stack([one.present for one in found])


def test_colours_are_believed_where_both_traversals_have_one_light() -> None:
    levels = np.linspace(80, 180, N)
    by_day = histograms_of(levels)
    assert traversals.histogram_trust(*histograms_of(levels + 2), *by_day) > 0.9
    assert traversals.histogram_trust(*histograms_of(levels * 0.4), *by_day) == 0.0
    one = traversals.histogram_trust(*histograms_of(levels[:1] * 0.4), *by_day)
    assert 0.5 < one < 1.0  # one dark image may be a dark place
    none = by_day[0][:0], by_day[1][:0]
    assert traversals.histogram_trust(*none, *by_day) == 1.0


def test_the_score_falls_with_divergence_only_where_colours_are_believed() -> None:
    votes, likeness = np.full(3, 0.2, np.float32), np.full(3, 0.5, np.float32)
    jeffrey = np.array([0.0, 0.15, 1.3], np.float32)
    believed = traversals.fuse(VocabConfig(), votes, jeffrey, likeness, 1.0)
    np.testing.assert_allclose(believed, (0.2 + 0.1 * np.exp(-jeffrey / 0.15) + 0.4 * 0.5) / 1.5, rtol=1e-5)
    assert np.ptp(traversals.fuse(VocabConfig(), votes, jeffrey, likeness, 0.0)) == 0.0
