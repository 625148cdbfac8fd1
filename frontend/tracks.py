"""Corners that are being followed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corners followed up to one frame: ``ids`` (N,) int64, each once, ``pixels`` (N, 2) float32 as seen."""

    ids: NDArray[np.int64]
    pixels: NDArray[np.float32]

    @staticmethod
    def none() -> "Tracks":
        """Return no tracks."""
        return Tracks(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.ids)

    def __getitem__(self, keep: NDArray[np.bool_]) -> "Tracks":
        """Select by mask."""
        return Tracks(self.ids[keep], self.pixels[keep])

    def __add__(self, more: "Tracks") -> "Tracks":
        """Return these and then the others, whose ids must be different ones."""
        return Tracks(np.concatenate([self.ids, more.ids]), np.vstack([self.pixels, more.pixels]))


def shared(a: NDArray[np.int64], b: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where the ids that are in both a (N,) and b (M,) stand in each, (K,) and (K,), ascending in a.

    An id is in each once.
    """
    if len(b) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    order = np.argsort(b)
    place = order[np.minimum(np.searchsorted(b, a, sorter=order), len(b) - 1)]
    both = np.flatnonzero(b[place] == a)
    return both, place[both]


class TrackAges:
    """Counts for how many posed frames of a session each track has lived."""

    def __init__(self) -> None:
        self._ids = np.zeros(0, np.int64)  # ascending
        self._ages = np.zeros(0, np.int32)

    def step(self, ids: NDArray[np.int64]) -> None:
        """Take the tracks (N,) of the next posed frame; others are forgotten."""
        ids = np.sort(ids)
        self._ids, self._ages = ids, self.of(ids) + np.int32(1)

    def of(self, ids: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return in how many posed frames in a row tracks (N,) have been seen, 0 for unknown ones."""
        if len(self._ids) == 0:
            return np.zeros(len(ids), np.int32)
        index = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where(self._ids[index] == ids, self._ages[index], np.int32(0))
