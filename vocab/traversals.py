"""Two sets of images against each other: what all images of a set have in common says nothing of places.

A camera at night, behind a fisheye or held towards one side of the path leaves the same marks on every image of its
traversal. Taking the mean of each traversal off its views leaves what tells places apart (as descriptors are
standardised for each condition: Schubert, Neubert and Protzel, ICRA 2020), and where the colours of two traversals
differ as a whole, colours of single images are no evidence.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.vocab import histogram
from seamark.vocab.config import VocabConfig
from seamark.vocab.view import COLUMNS, ORIENTATIONS, SHIFTS

PRIOR_IMAGES: Final = 10
"""As many images' worth of doubt in a mean: single images are compared as they are."""

AS_THEY_ARE: Final = 0.25
"""Weight of the likeness of two views with all they show: a traversal may have a place in common."""

USUAL_DIVERGENCE: Final = 0.1  # of an image's histograms from the mean of its traversal
MOST_DISAGREEMENT: Final = 0.5
"""Traversals whose means diverge by this share of what their images diverge from the mean agree in no colour."""

SAME_DIVERGENCE: Final = 0.15  # two images of one place in one light diverge by less


def view_likeness(queries: NDArray[np.int8], places: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return how alike the views of two traversals are beyond what each has in common: (m, n) float32 in 0..1.

    ``queries`` (m, 9, 16, 8) and ``places`` (n, 9, 16, 8) are View.cells. The result is the correlation under the best
    of the sideways shifts, as in :func:`seamark.vocab.view.likeness_to_all`. Neither the order of images nor that of
    places matters; of few queries little is known, so that they are taken to have in common what the places have.
    """
    if not len(queries) or not len(places):
        return np.zeros((len(queries), len(places)), np.float32)
    common = _common(places, _plain(places))
    ours = queries - _common(queries, common)
    theirs = places - common
    best = np.zeros((len(ours), len(theirs)), np.float32)
    for shift in SHIFTS:
        seen = _unit(ours[:, :, max(0, shift) : COLUMNS + min(0, shift)])
        met = _unit(theirs[:, :, max(0, -shift) : COLUMNS - max(0, shift)])
        np.maximum(best, seen @ met.T, out=best)
    return np.minimum(best, 1.0)


def histogram_trust(
    query_values: NDArray[np.float32],
    query_present: NDArray[np.bool_],
    place_values: NDArray[np.float32],
    place_present: NDArray[np.bool_],
) -> float:
    """Return how far colours are evidence between two traversals, 1 for the same light down to 0.

    ``*_values`` (n, 6, bins) and ``*_present`` (n, 6) are histograms of their images. The mean histograms of both are
    compared; how much they may differ is measured by how much the places differ from their own mean.
    """
    if not len(query_values) or not len(place_values):
        return 1.0
    both = np.flatnonzero(query_present.any(axis=0) & place_present.any(axis=0))
    apart, own = [], []
    for channel in both:
        places = place_values[place_present[:, channel], channel].astype(np.float64)
        queries = query_values[query_present[:, channel], channel].astype(np.float64)
        mean = places.mean(axis=0)
        shrunk = (queries.sum(axis=0) + PRIOR_IMAGES * mean) / (len(queries) + PRIOR_IMAGES)
        apart.append(float(histogram.jeffrey_divergence(shrunk, mean)))
        spread = float(histogram.jeffrey_divergence(places, mean).sum())
        own.append((spread + PRIOR_IMAGES * USUAL_DIVERGENCE) / (len(places) + PRIOR_IMAGES))
    if not apart:
        return 1.0
    return float(np.clip(1.0 - np.sum(apart) / (MOST_DISAGREEMENT * np.sum(own)), 0.0, 1.0))


def fuse(
    config: VocabConfig,
    votes: NDArray[np.floating],
    jeffrey: NDArray[np.floating],
    likeness: NDArray[np.floating],
    trust: float,
) -> NDArray[np.float32]:
    """Return the scores, 0..1, of images of two traversals; the arrays are of one shape.

    As in the place index, but divergences count where they are as small as those of one place in one light, times
    ``trust``.
    """
    by_colour = config.histogram_weight * trust * np.exp(-jeffrey / SAME_DIVERGENCE)
    total = config.votes_weight * votes + by_colour + config.view_weight * likeness
    weights = config.votes_weight + config.histogram_weight + config.view_weight
    return np.clip(total / weights, 0.0, 1.0).astype(np.float32)


def _plain(cells: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return what is common to any images: edges everywhere alike, (1, 1, 8)."""
    plain = np.zeros((1, 1, ORIENTATIONS))
    plain[..., : ORIENTATIONS // 2] = cells[..., : ORIENTATIONS // 2].mean(dtype=np.float64)
    return plain


def _common(cells: NDArray[np.int8], prior: NDArray[np.floating]) -> NDArray[np.float32]:
    # A sum of whole numbers is the same in any order.
    total = cells.sum(axis=0, dtype=np.int64)
    mean: NDArray[np.float32] = ((total + PRIOR_IMAGES * prior) / (len(cells) + PRIOR_IMAGES)).astype(np.float32)
    return mean


def _unit(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    flat = cells.reshape(len(cells), -1)
    unit: NDArray[np.float32] = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-3)
    return unit
