"""Colour histograms of a thumbnail and their divergence: the second, independent cue for places."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import ObservationError

CHANNELS: Final = ("r", "g", "b", "h", "s", "l")
HUE, LIGHTNESS = CHANNELS.index("h"), CHANNELS.index("l")
MAX_DIVERGENCE: Final = 2.0 * float(np.log(2.0))
"""The divergence of two distributions that share no bin."""


@dataclass(frozen=True, eq=False)
class Histograms:
    """Smoothed histograms of one image.

    ``values`` (6, bins) float32, each row sums to one, in the order of CHANNELS; ``present`` (6,) bool says which rows
    hold something. Absent rows are zero.
    """

    values: NDArray[np.float32]
    present: NDArray[np.bool_]


def smoothing_matrix(bins: int, sigma_bins: float, *, circular: bool) -> NDArray[np.float64]:
    """Return the (bins, bins) matrix that smooths a row of counts by a Gaussian and keeps its sum.

    The Gaussian ends at four standard deviations, so that far bins stay exactly empty. At the ends of a range that is
    not circular each bin shares its count among the bins that exist.
    """
    if sigma_bins == 0.0:
        return np.eye(bins)
    distance = np.abs(np.arange(bins)[:, None] - np.arange(bins)[None])
    if circular:
        distance = np.minimum(distance, bins - distance)
    kernel = np.where(distance <= 4.0 * sigma_bins, np.exp(-0.5 * (distance / sigma_bins) ** 2), 0.0)
    normalised: NDArray[np.float64] = kernel / kernel.sum(axis=1, keepdims=True)
    return normalised


def describe(thumbnail: NDArray[np.uint8], bins: int, sigma_bins: float) -> Histograms:
    """Return the r, g, b, h, s, l histograms of a (h, w, 3) BGR image, or l alone of a (h, w) grey one.

    Hue and saturation are OpenCV's HLS scaled to 0..255; lightness is the grey value (luma) and not HLS's mid-range, so
    that a colour and a grey image of one place compare. Each pixel counts in the hue histogram by its saturation,
    because the hue of grey is noise. A BGR image whose channels are all equal has no colour and is taken as grey.

    Raises:
        ObservationError: a thumbnail of another shape or type, or an empty one.
    """
    if thumbnail.dtype != np.uint8 or thumbnail.ndim not in (2, 3) or not thumbnail.size:
        raise ObservationError(f"a thumbnail must be uint8 of (h, w) or (h, w, 3), not {_kind(thumbnail)}")
    if thumbnail.ndim == 3 and thumbnail.shape[2] != 3:
        raise ObservationError(f"a thumbnail must be uint8 of (h, w) or (h, w, 3), not {_kind(thumbnail)}")
    counts = np.zeros((len(CHANNELS), bins))
    if thumbnail.ndim == 3 and (thumbnail != thumbnail[..., :1]).any():
        hue, _, saturation = cv2.split(cv2.cvtColor(thumbnail, cv2.COLOR_BGR2HLS_FULL))
        lightness = cv2.cvtColor(thumbnail, cv2.COLOR_BGR2GRAY)
        planes = (*(thumbnail[..., c] for c in (2, 1, 0)), hue, saturation, lightness)
        for channel, plane in enumerate(planes):
            counts[channel] = _count(plane, bins, saturation if channel == HUE else None)
        present = np.ones(len(CHANNELS), bool)
    else:
        counts[LIGHTNESS] = _count(thumbnail if thumbnail.ndim == 2 else thumbnail[..., 0], bins, None)
        present = np.arange(len(CHANNELS)) == LIGHTNESS
    return Histograms(_smooth(counts, present, sigma_bins), present)


def jeffrey_divergence(p: NDArray[np.float32], q: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return J(p, q) = sum p ln(p / m) + q ln(q / m) with m = (p + q) / 2 over the last axis.

    Puzicha, Hofmann and Buhmann 1997, twice the Jensen-Shannon divergence: symmetric, 0 for equal distributions, at
    most 2 ln 2. Convention for empty bins: a term with p = 0 (or q = 0) counts nothing, its limit; m is then not zero
    unless both are. ``p`` and ``q`` broadcast against each other.
    """
    middle = (p + q) / 2
    # Where a bin is empty the quotient is replaced by 1, whose logarithm is 0; m >= p / 2 > 0 elsewhere.
    log_p = np.log(np.divide(p, middle, out=np.ones_like(middle), where=p > 0))
    log_q = np.log(np.divide(q, middle, out=np.ones_like(middle), where=q > 0))
    divergence: NDArray[np.float32] = np.maximum((p * log_p + q * log_q).sum(axis=-1), 0)
    return divergence


def divergence_to_all(
    query: Histograms, values: NDArray[np.float32], present: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the mean divergence of one image to N others over the channels that both have.

    ``values`` (N, 6, bins) and ``present`` (N, 6) are those of the others; the result is (N,) float32.
    """
    common = present & query.present
    total = np.zeros(len(values), np.float32)
    for channel in np.flatnonzero(common.any(axis=0)):  # one at a time: the intermediate arrays stay in the cache
        divergence = jeffrey_divergence(values[:, channel], query.values[channel])
        total += np.where(common[:, channel], divergence, 0)
    mean: NDArray[np.float32] = total / np.maximum(common.sum(axis=1), 1).astype(np.float32)
    return mean


def _count(plane: NDArray[np.uint8], bins: int, weights: NDArray[np.uint8] | None) -> NDArray[np.float64]:
    index = plane.astype(np.int64).ravel() * bins // 256
    by = None if weights is None else weights.ravel().astype(np.float64)
    return np.bincount(index, by, minlength=bins).astype(np.float64)


def _smooth(counts: NDArray[np.float64], present: NDArray[np.bool_], sigma_bins: float) -> NDArray[np.float32]:
    bins = counts.shape[1]
    smoothed = counts @ smoothing_matrix(bins, sigma_bins, circular=False)
    smoothed[HUE] = counts[HUE] @ smoothing_matrix(bins, sigma_bins, circular=True)
    smoothed[present] /= smoothed[present].sum(axis=1, keepdims=True)
    return smoothed.astype(np.float32)


def _kind(array: NDArray[np.uint8]) -> str:
    return f"{array.dtype} of {array.shape}"
