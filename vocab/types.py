"""What the vocabulary takes and gives."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PlaceObservation:
    """What one keyframe shows, as far as place recognition goes.

    ``descriptors`` (N, 128) uint8 RootSIFT, ``points`` (N, 2) float32 pixels, ``thumbnail`` (h, w) grey or (h, w, 3)
    BGR uint8. ``id`` and ``session`` are the keyframe's. ``scales`` (N,) float32 pixels and ``angles`` (N,) float32
    radians are asked for by an index that compares them (``vocab.geometry``) and by no other.
    """

    id: int
    session: int
    stamp_ns: int
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float32]
    thumbnail: NDArray[np.uint8]
    scales: NDArray[np.float32] | None = None
    angles: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Candidate:
    """One place that may be the one seen, with its evidence.

    ``score`` fuses votes, histograms and view, 0..1, higher is better. ``votes`` is the tf-idf similarity in 0..1.
    ``jeffrey`` is the Jeffrey divergence of the colour histograms, 0 for equal ones. ``view`` is the likeness of the
    edges of the whole image, 0..1.
    """

    id: int
    score: float
    votes: float
    jeffrey: float
    view: float = 0.0


@dataclass(frozen=True)
class Candidates:
    """The ranked places for one keyframe or query; ``query_id`` is -1 for a query that is not a keyframe."""

    query_id: int
    stamp_ns: int
    ranked: tuple[Candidate, ...]
