"""Descriptor matches between two images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    not counted twice. Squared distances are exact: whole numbers below 2^24 in float32, whatever the order of sums.
    """
    if len(query) < 2 or len(match) < 2:
        return Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))
    a = query.descriptors.astype(np.float32)
    b = match.descriptors.astype(np.float32)
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None, :] - 2 * (a @ b.T)
    forward, forward_ratio = _nearest(squared, ratio)
    backward, backward_ratio = _nearest(np.ascontiguousarray(squared.T), ratio)
    rows = np.arange(len(a))
    rows = rows[(backward[forward] == rows) & forward_ratio & backward_ratio[forward]]
    order = rows[np.argsort(squared[rows, forward[rows]], kind="stable")]
    order = order[_first_of_pixel(query.points[order])]
    order = np.sort(order[_first_of_pixel(match.points[forward[order]])])
    return Matches(order.astype(np.int64), forward[order].astype(np.int64))


def _nearest(squared: NDArray[np.float32], ratio: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nearest column of each row and whether it beats the second nearest by the ratio."""
    two = np.partition(squared, 1, axis=1)[:, :2]
    return squared.argmin(1), two[:, 0] < ratio * ratio * two[:, 1]


def _first_of_pixel(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the ascending indices of the first point in each pixel."""
    _, first = np.unique(np.round(points).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)
