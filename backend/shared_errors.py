"""What the errors of many matches have in common, which no number of matches averages out.

What lens, rolling shutter and changed perspective do to key points they do alike to neighbours: the errors of one cell
of the image share a part, which the residuals show, and a hundred matches on one poster do not say a hundred times as
much as one. What is alike all over the image hides in the pose itself. The residuals show it only as far as it varies:
what they exceed the noise of key points by is taken for an angle that the whole view may be wrong by. A depth camera
errs in common by much of what its readings differ by, which makes the way between the views too long or too short.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

CELLS: Final = (8, 6)
# The share that is expected counts like so many products of two neighbours' errors.
PRIOR_PRODUCTS: Final = 600.0
# The pose has taken a part of what neighbours share before it is measured.
HIDDEN: Final = 1.3
MOST_SHARE: Final = 0.6
SQRT2: Final = float(np.sqrt(2.0))  # both views have a key point


def cells_of(uv: Array, camera: Camera) -> Cells:
    """Return the number (K,) of the cell of an 8 x 6 grid in which each pixel (K, 2) lies."""
    cells = np.clip(uv / (camera.width, camera.height) * CELLS, 0, np.array(CELLS) - 1).astype(np.int64)
    return np.asarray(cells[:, 1] * CELLS[0] + cells[:, 0])


def measured_share(views: Sequence[tuple[Array, Array, Cells]], expected: float) -> float:
    """Return which share of the variance of errors is common to those of one cell.

    ``views``: whitened errors (K, D) times the root of their weights, the weights (K,) and cells (K,). It is the mean
    product of two errors of a cell over the mean square; ``expected`` where there are few.
    """
    products, pairs, squared, count = 0.0, 0.0, 0.0, 0.0
    for errors, weights, cells in views:
        sums = np.stack([np.bincount(cells, errors[:, axis]) for axis in range(errors.shape[1])], axis=1)
        own = np.bincount(cells, (errors**2).sum(axis=1))
        products += float(((sums**2).sum(axis=1) - own).sum())
        pairs += errors.shape[1] * float((np.bincount(cells, weights) ** 2 - np.bincount(cells, weights**2)).sum())
        squared += float(own.sum())
        count += errors.shape[1] * float(weights.sum())
    variance = max(squared / max(count, 1.0), 1e-12)
    share = (products / variance + PRIOR_PRODUCTS * expected) / (pairs + PRIOR_PRODUCTS)
    return float(np.clip(HIDDEN * share, 0.0, MOST_SHARE))


def independent_share(cells: Cells, share: float) -> Array:
    """Return how much (K,) of each error is news: of n in a cell that share a part, one per 1 + (n - 1) share."""
    return np.asarray(1 / (1 + (np.bincount(cells, minlength=1)[cells] - 1) * share))


def excess_angle(variance_scale: float, share: float, focal_px: float, config: VerificationConfig) -> float:
    """Return the standard deviation (rad) of the angle that the whole view may be wrong by.

    ``variance_scale`` is what the squared errors are per expected one, ``share`` what neighbours have in common of it:
    errors that neighbours do not share are noise, however large.
    """
    common = max(variance_scale - 1.0, 0.0) * min(1.0, share / max(config.shared_share, 1e-9))
    return float(config.excess_share * SQRT2 * config.noise_px * np.sqrt(common) / focal_px)


def systematic(
    T_match_query: Array, depth: float, depth_noise: float, angle: float, config: VerificationConfig
) -> Array:
    """Return standard deviations (6,), rotation first, of what the matches of two views err by in common.

    ``depth`` is the median of the scene, ``depth_noise`` the deviation of depths as a share of them, ``angle`` that
    of the whole view.
    """
    turned, moved = float(se3.rotation_angle(T_match_query[:3, :3])), float(np.linalg.norm(T_match_query[:3, 3]))
    rotation = np.deg2rad(config.rotation_floor_deg) + config.rotation_systematic * turned
    length = np.hypot(config.translation_systematic, config.depth_systematic * depth_noise)
    translation = config.translation_floor_fraction * depth + config.turn_systematic * depth * turned + length * moved
    return np.repeat([np.hypot(rotation, angle), np.hypot(translation, depth * angle)], 3)
