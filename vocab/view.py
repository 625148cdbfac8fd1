"""The whole image as a coarse grid of edge orientations: the third cue for places, which hardly minds light."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import ObservationError

ROWS: Final = 9
COLUMNS: Final = 16
ORIENTATIONS: Final = 8
NO_CELLS: Final = np.zeros((0, ROWS, COLUMNS, ORIENTATIONS), np.int8)
SHIFTS: Final = tuple(range(-4, 5))
"""Sideways shifts, in columns, under which two views are compared: a quarter of the picture to either side."""

WIDTH_PX, HEIGHT_PX, BLUR_PX = 96, 72, 0.7
CONTRAST_FLOOR = 4.0  # grey levels per pixel: weaker edges than this count less, however flat their surroundings
DIRECTION_WEIGHT = 0.6  # of what changes sign where dark and bright swap, as they do under lamps
FULL_SCALE = 127.0
BLOCK_PLACES = 4096  # widened to float32 at a time


@dataclass(frozen=True, eq=False)
class View:
    """The edges of one image: ``cells`` (9, 16, 8) int8, for each cell four sums and four differences.

    Orientations are counted over the whole circle in eight bins. A bin and its opposite differ only in what is dark and
    what is bright: the first four values are their sum, the last four their difference times 0.6. ``totals`` (2, 16)
    float32 are, for each column, the total of its sums and of all its squares.
    """

    cells: NDArray[np.int8]
    totals: NDArray[np.float32]


def describe(thumbnail: NDArray[np.uint8]) -> View:
    """Return the edges of a (h, w) grey or (h, w, 3) BGR uint8 image, which is brought to 96 x 72 pixels.

    Gradients are divided by their average around them, so that a lamp does not outshine the rest of the picture, and
    the square root of each cell's histogram is kept (histograms of oriented gradients: Dalal and Triggs, CVPR 2005).

    Raises:
        ObservationError: an image of another shape or type, or an empty one.
    """
    if thumbnail.dtype != np.uint8 or thumbnail.shape[2:] not in ((), (3,)) or thumbnail.ndim < 2 or not thumbnail.size:
        raise ObservationError(f"a thumbnail must be uint8, (h, w) or (h, w, 3), not {thumbnail.shape}")
    grey = thumbnail if thumbnail.ndim == 2 else cv2.cvtColor(thumbnail, cv2.COLOR_BGR2GRAY)
    shrinks = grey.shape[1] >= WIDTH_PX and grey.shape[0] >= HEIGHT_PX
    small = cv2.resize(
        grey.astype(np.float32), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    small = cv2.GaussianBlur(small, (0, 0), BLUR_PX)
    x, y = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    strength = np.hypot(x, y)
    strength /= cv2.GaussianBlur(strength, (0, 0), WIDTH_PX / 8) + CONTRAST_FLOOR
    histograms = np.sqrt(_pool(strength, np.arctan2(y, x)))
    half = ORIENTATIONS // 2
    one, opposite = histograms[..., :half], histograms[..., half:]
    folded = np.concatenate([one + opposite, DIRECTION_WEIGHT * (one - opposite)], axis=2)
    largest = max(float(np.abs(folded).max()), 1e-6)
    cells = np.rint(folded * (FULL_SCALE / largest)).astype(np.int8)
    wide = cells.astype(np.float32)
    return View(cells, np.stack([wide[..., :half].sum(axis=(0, 2)), (wide**2).sum(axis=(0, 2))]))


def _pool(strength: NDArray[np.float32], angle: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (9, 16, 8): how strong the edges of each orientation are in and around each cell."""
    position = (angle % (2 * np.pi)) / (2 * np.pi) * ORIENTATIONS
    low = np.floor(position).astype(np.int64) % ORIENTATIONS
    share = (position - np.floor(position)).astype(np.float32)
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    planes = np.zeros((ORIENTATIONS, HEIGHT_PX, WIDTH_PX), np.float32)
    planes[low, rows, columns] += strength * (1 - share)
    planes[(low + 1) % ORIENTATIONS, rows, columns] += strength * share
    blur = WIDTH_PX / COLUMNS / 2
    pooled = [
        cv2.resize(cv2.GaussianBlur(plane, (0, 0), blur), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
        for plane in planes
    ]
    return np.maximum(np.stack(pooled, axis=2), 0)


def likeness_to_all(view: View, cells: NDArray[np.int8], totals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how alike a view is to each of those given by ``cells`` (n, 9, 16, 8) and ``totals`` (n, 2, 16).

    The result is (n,) float32 in 0..1: the correlation of what both show when one is shifted sideways against the
    other, the best of nine shifts; correlation below zero counts as none. A view without any edge is like none.
    """
    windows, spans = _windows(view)
    running = np.cumsum(np.pad(totals, ((0, 0), (0, 0), (1, 0))), axis=2, dtype=np.float64)
    total, square = (running[..., spans[:, 1]] - running[..., spans[:, 0]]).transpose(1, 0, 2)
    # The mean of the query's window is zero, so that the place's needs to be taken off its length only.
    count = ROWS * (spans[:, 1] - spans[:, 0]) * (ORIENTATIONS // 2)
    lengths = np.sqrt(np.maximum(square - total**2 / count, 1.0))
    likeness = np.zeros(len(cells), np.float32)
    for start in range(0, len(cells), BLOCK_PLACES):
        block = slice(start, start + BLOCK_PLACES)
        products = cells[block].reshape(-1, windows.shape[1]).astype(np.float32) @ windows.T
        likeness[block] = np.clip((products / lengths[block]).max(axis=1), 0, 1)
    return likeness


def _windows(view: View) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return for each shift what of the view meets a place, of mean 0 and length 1, and the columns where it does.

    The first is (9, 1152) float32, zero where nothing meets, the second (9, 2).
    """
    windows, spans = [], []
    for shift in SHIFTS:
        seen = view.cells[:, max(0, shift) : COLUMNS + min(0, shift)].astype(np.float32)
        seen[..., : ORIENTATIONS // 2] -= seen[..., : ORIENTATIONS // 2].mean()
        start = max(0, -shift)
        window = np.zeros(view.cells.shape, np.float32)
        window[:, start : start + seen.shape[1]] = seen / max(float(np.sqrt((seen**2).sum())), 1e-6)
        windows.append(window.ravel())
        spans.append((start, start + seen.shape[1]))
    return np.stack(windows), np.array(spans)
