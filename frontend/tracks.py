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
