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


class TrackAges:
    """Counts for how many posed frames each track has lived."""

    def __init__(self) -> None:
        self._session = -1
        self._ids = np.zeros(0, np.int64)
        self._ages = np.zeros(0, np.int32)

    def step(self, session: int, ids: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the ages (N,) of the tracks (N,) of the next posed frame; those not seen before are 1."""
        ages = np.ones(len(ids), np.int32)
        if session == self._session:
            _, now, before = np.intersect1d(ids, self._ids, assume_unique=True, return_indices=True)
            ages[now] += self._ages[before]
        self._session, self._ids, self._ages = session, ids, ages
        return ages
