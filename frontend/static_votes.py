"""Whom to believe where landmarks disagree about the pose: what covers the picture, and what has stood still for long.

A thing that moves can hold most of the tracks when it stands out by its texture; that it fills most of the picture as
well, and has been followed for as long as what is behind it, is rare. So votes are given to parts of the picture and
not to tracks, and a track that has agreed with the pose for many frames has more than a new one.
"""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera

COLUMNS, ROWS = 8, 6  # parts of the picture
FULL_AGE = 15  # frames from which on a track does not become more credible


def static_votes(pixels: NDArray[np.floating], ages: NDArray[np.integer], camera: Camera) -> NDArray[np.float64]:
    """Return the votes (N,) of tracks at pixels (N, 2) that have lived for ``ages`` (N,) posed frames."""
    column = np.clip(pixels[:, 0] * (COLUMNS / camera.width), 0, COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * (ROWS / camera.height), 0, ROWS - 1).astype(np.int64)
    part = column + COLUMNS * row
    crowd = np.bincount(part, minlength=COLUMNS * ROWS)[part]
    votes: NDArray[np.float64] = (1.0 + np.minimum(ages, FULL_AGE)) / crowd
    return votes
