"""Soft shadows that are part of pictures: corners that light reaches less, and the floor under and about things.

The renderer's lamps cast no shadow; these cost nothing per frame and are the same whatever the light.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.textures import Field, Image, to_image

DEPTH, REACH_M = 0.34, 0.28  # how dark a corner is, and how far that reaches
CONTACT = ((0.30, 0.05), (0.30, 0.22))  # darkness and blur (m) under things


def edges(height: int, width: int, pixels_per_metre: float, sides: Sequence[float | NDArray[np.floating]]) -> Field:
    """Return factors (H, W) that darken towards the top, right, bottom and left edge.

    ``sides`` says how much of the darkness each edge has: a number from 0 to 1, or one per pixel along the edge.
    """
    top, right, bottom, left = sides
    rows, columns = (
        DEPTH * np.exp(-np.arange(length) / (REACH_M * pixels_per_metre)).astype(np.float32)
        for length in (height, width)
    )
    shade = np.ones((height, width), np.float32)
    shade *= 1 - rows[:, None] * np.broadcast_to(top, width)[None]
    shade *= 1 - rows[::-1, None] * np.broadcast_to(bottom, width)[None]
    shade *= 1 - columns[None] * np.broadcast_to(left, height)[:, None]
    shade *= 1 - columns[None, ::-1] * np.broadcast_to(right, height)[:, None]
    return shade


def along(length: int, pixels_per_metre: float, openings: Sequence[tuple[float, float]]) -> Field:
    """Return how much of the darkness of a corner an edge of ``length`` px has: none where (start, end) m is open."""
    weights = np.ones((1, length), np.float32)
    for start, end in openings:
        weights[:, int(start * pixels_per_metre) : int(end * pixels_per_metre)] = 0
    blurred: Field = cv2.GaussianBlur(weights, (0, 0), 0.1 * pixels_per_metre, borderType=cv2.BORDER_REPLICATE)[0]
    return blurred


def contact(height: int, width: int, pixels_per_metre: float, outlines: Sequence[NDArray[np.floating]]) -> Field:
    """Return factors (H, W) that darken under and about things with ``outlines`` (4, 2) px."""
    mask = np.zeros((height, width), np.float32)
    for outline in outlines:
        cv2.fillConvexPoly(mask, np.rint(outline).astype(np.int32), 1.0)
    shade = np.ones((height, width), np.float32)
    for darkness, blur_m in CONTACT:
        shade -= darkness * cv2.GaussianBlur(mask, (0, 0), blur_m * pixels_per_metre)
    return shade


def shaded(image: Image, *factors: Field) -> Image:
    """Return the picture times factors (H, W)."""
    values = image.astype(np.float32)
    for factor in factors:
        values *= factor[..., None]
    return to_image(values)
