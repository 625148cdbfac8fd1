"""SIFT key points with RootSIFT descriptors, and their matching by ratio and mutual check."""

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.kernels import native
from seamark.frontend.types import Features

GREY_LEVELS = 255
DESCRIPTOR_SCALE = 512.0  # sqrt of an L1-normalised SIFT bin rarely exceeds 0.5


def grey_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the (H, W) grey version of a grey or BGR image."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def root_sift(descriptors: NDArray[np.float32] | NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Map SIFT descriptors (N, 128) to RootSIFT in uint8: Euclidean distance becomes Hellinger's (Arandjelovic
    2012).
    """
    descriptors = descriptors.astype(np.float32, copy=False)
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return np.minimum(np.rint(DESCRIPTOR_SCALE * np.sqrt(descriptors / total)), 255).astype(np.uint8)


def extract_features(
    image: NDArray[np.uint8],
    n_features: int,
    contrast: float = 0.015,
    mask: NDArray[np.uint8] | None = None,
    max_pixels: int | None = None,
    way: native.RightOfWay | None = None,
) -> Features:
    """Find at most ``n_features`` SIFT key points (Lowe 2004) in a grey or BGR uint8 image, strongest first.

    None is taken where ``mask`` (H, W) uint8 is zero. An image of more than ``max_pixels`` is reduced to so many first;
    points and scales are those of the whole image all the same. Who takes ``way`` meanwhile is let pass.
    """
    grey, scale = grey_of(image), 1.0
    if max_pixels is not None and grey.size > max_pixels:
        scale = float(np.sqrt(max_pixels / grey.size))
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        mask = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    mask = None if mask is None else np.ascontiguousarray(mask, np.uint8)
    table, descriptors = native.sift(np.ascontiguousarray(grey), mask, n_features, GREY_LEVELS * contrast, way)
    whole = np.array(image.shape[1::-1]) / np.array(grey.shape[1::-1])
    table[:, :2] = (table[:, :2] + 0.5) * whole - 0.5
    table[:, 2] /= scale
    return Features(
        points=np.ascontiguousarray(table[:, :2]),
        scales=np.ascontiguousarray(table[:, 2]),
        angles=np.deg2rad(table[:, 3]),
        descriptors=root_sift(descriptors),
    )


def match_descriptors(
    a: NDArray[np.uint8], b: NDArray[np.uint8], *, ratio: float = 0.8, both_ways: bool = False
) -> NDArray[np.int64]:
    """Match descriptors (N, 128) and (M, 128): index pairs (K, 2), by ascending index of a, of mutual neighbours.

    A pair must pass the ratio test (Lowe 2004) from a to b, with ``both_ways`` also from b to a. Squared distances are
    exact, whatever the order of sums: whole numbers below 2^24 in float32.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    af, bf = a.astype(np.float32), b.astype(np.float32)
    squared = af @ bf.T
    squared *= -2
    squared += (af**2).sum(1)[:, None]
    squared += (bf**2).sum(1)
    nearest = squared.argmin(axis=1)
    rows = np.flatnonzero(squared.argmin(axis=0)[nearest] == np.arange(len(a)))
    columns = nearest[rows]
    distinct = _distinct(squared[rows], columns, ratio)
    rows, columns = rows[distinct], columns[distinct]
    if both_ways:
        distinct = _distinct(squared[:, columns].T, rows, ratio)
        rows, columns = rows[distinct], columns[distinct]
    return np.column_stack([rows, columns]).astype(np.int64)


def _distinct(squared: NDArray[np.float32], nearest: NDArray[np.int64], ratio: float) -> NDArray[np.bool_]:
    """Return of which rows (N,), which may be overwritten, the ``nearest`` column beats all others by the ratio."""
    rows = np.arange(len(nearest))
    best = squared[rows, nearest]
    squared[rows, nearest] = np.inf
    return np.asarray(best < ratio**2 * squared.min(axis=1, initial=np.inf))


def thumbnail_of(image: NDArray[np.uint8], longer_side_px: int) -> NDArray[np.uint8]:
    """Return a copy scaled so that its longer side has ``longer_side_px`` pixels (never enlarged)."""
    height, width = image.shape[:2]
    scale = min(1.0, longer_side_px / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
