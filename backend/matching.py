"""Descriptor matches between two images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.features import match_descriptors
from seamark.frontend.types import Features


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of features: ``query`` and ``match`` (M,) int64 are indices into the two images' features."""

    query: NDArray[np.int64]
    match: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.query)


def match_features(query: Features, match: Features, ratio: float) -> Matches:
    """Return the mutual nearest neighbours that pass the ratio test (Lowe 2004) in both directions.

    Of key points at the same pixel (one per dominant orientation) only the best pair is kept, so that inliers are
    not counted twice.
    """
    pairs = match_descriptors(query.descriptors, match.descriptors, ratio=ratio, both_ways=True)
    rows, columns = pairs.T
    difference = query.descriptors[rows].astype(np.int32) - match.descriptors[columns]
    best_first = np.argsort((difference**2).sum(axis=1), kind="stable")
    kept = best_first[_first_of_pixel(query.points[rows[best_first]])]
    kept = np.sort(kept[_first_of_pixel(match.points[columns[kept]])])
    return Matches(rows[kept], columns[kept])


def _first_of_pixel(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the ascending indices of the first point in each pixel."""
    _, first = np.unique(np.round(points).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)
