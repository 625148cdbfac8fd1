"""Procedural surfaces that look natural enough for SIFT: plaster, brick, wood, tiles, stone, carpet.

Every function takes a random generator, a size in pixels and pixels per metre, because patterns have a natural size,
and returns a BGR uint8 image (height, width, 3). The same state of the generator gives the same picture.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Field = NDArray[np.float32]
Surface = Callable[[np.random.Generator, int, int, float], Image]


def noise(rng: np.random.Generator, height: int, width: int, cell_px: float, octaves: int = 4) -> Field:
    """Return multi-octave value noise (height, width) float32, mean about 0 and standard deviation about 1.

    ``cell_px`` is the size of the coarsest blobs; every octave halves it and weighs 0.6 of the one before.
    """
    total = np.zeros((height, width), np.float32)
    weight, power = 1.0, 0.0
    for _ in range(octaves):
        rows, columns = (max(2, int(np.ceil(side / cell_px)) + 1) for side in (height, width))
        grid = rng.standard_normal((rows, columns), np.float32)
        total += np.float32(weight) * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        power += weight**2
        weight *= 0.6
        cell_px = max(1.0, cell_px / 2)
    return (total / np.float32(0.75 * np.sqrt(power))).astype(np.float32)


def to_image(values: NDArray[np.floating] | Image) -> Image:
    """Round and clip (H, W, 3) grey levels to uint8."""
    image: Image = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return image


def random_colour(rng: np.random.Generator, low: float = 40, high: float = 220, saturation: float = 1.0) -> Field:
    """Return a random BGR colour (3,) float32; ``saturation`` 0 gives greys."""
    colour = rng.uniform(low, high, 3)
    mean = colour.mean()
    muted: Field = (mean + saturation * (colour - mean)).astype(np.float32)
    return muted


def tint(colour: NDArray[np.floating], relief: NDArray[np.floating]) -> Field:
    """Return colour (3,) times 1 + relief (H, W), as float32 (H, W, 3)."""
    return ((1 + relief)[..., None] * colour).astype(np.float32)


def plaster(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return painted plaster: stains, roughness, specks, hair cracks."""
    colour = random_colour(rng, 120, 215, 0.5)
    stains = 0.10 * noise(rng, height, width, 0.8 * pixels_per_metre, 3)
    rough = 0.07 * noise(rng, height, width, max(3.0, 0.06 * pixels_per_metre), 3)
    canvas = to_image(tint(colour, stains + rough))
    area = height * width / pixels_per_metre**2
    for _ in range(int(45 * area)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        shade = float(rng.choice([0.45, 0.65, 1.3]))
        axes = (int(rng.uniform(1, 2 + 0.02 * pixels_per_metre)), int(rng.uniform(1, 2 + 0.012 * pixels_per_metre)))
        cv2.ellipse(
            canvas, centre, axes, float(rng.uniform(0, 180)), 0, 360, (shade * colour).tolist(), -1, cv2.LINE_AA
        )
    for _ in range(int(1.2 * area) + 1):
        steps = rng.normal(0, 0.03 * pixels_per_metre, (int(rng.integers(8, 30)), 2))
        steps[:, int(rng.integers(2))] += 0.03 * pixels_per_metre
        path = np.cumsum(steps, axis=0) + rng.uniform(0, 1, 2) * (width, height)
        cv2.polylines(canvas, [path.astype(np.int32)], False, (0.55 * colour).tolist(), 1, cv2.LINE_AA)
    return canvas


def _bond(
    rng: np.random.Generator, height: int, width: int, brick_px: tuple[float, float], shift: float, joint_px: float
) -> tuple[Field, NDArray[np.bool_]]:
    """Return a random shade per brick (H, W) in -1..1 and where the joints are; odd rows move by ``shift`` bricks."""
    y, x = np.arange(height, dtype=np.float32)[:, None], np.arange(width, dtype=np.float32)[None]
    row = np.floor(y / brick_px[0])
    along = x / brick_px[1] + shift * (row % 2) + 0.05 * np.sin(7.0 * row)
    column = np.floor(along)
    shades = rng.uniform(-1, 1, (int(row.max()) + 1, int(column.max()) + 2)).astype(np.float32)
    joints = ((y % brick_px[0]) < joint_px) | ((along - column) * brick_px[1] < joint_px)
    return shades[row.astype(int), column.astype(int)], joints


def brick(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return a brick wall in running bond; every brick has its own shade, chips and grain."""
    colour = np.array([rng.uniform(45, 110), rng.uniform(60, 120), rng.uniform(120, 190)], np.float32)
    size = (pixels_per_metre * rng.uniform(0.07, 0.11), pixels_per_metre * rng.uniform(0.2, 0.3))
    shade, joints = _bond(rng, height, width, size, 0.5, max(1.5, 0.012 * pixels_per_metre))
    grain = 0.12 * noise(rng, height, width, max(2.0, 0.05 * pixels_per_metre), 3)
    weather = 0.10 * noise(rng, height, width, pixels_per_metre, 3)
    wall = tint(colour, 0.28 * shade + grain + weather)
    chips = noise(rng, height, width, max(3.0, 0.09 * pixels_per_metre), 3) > 2.1
    mortar = tint(random_colour(rng, 140, 200, 0.2), grain)
    return to_image(np.where((joints | chips)[..., None], mortar, wall))


def tiles(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return square tiles with shades of their own, marbling, and here and there a motif."""
    side = pixels_per_metre * rng.uniform(0.2, 0.4)
    first, second = random_colour(rng, 70, 220, 0.6), random_colour(rng, 70, 220, 0.6)
    shade, joints = _bond(rng, height, width, (side, side), 0.0, max(1.2, 0.008 * pixels_per_metre))
    veins = np.abs(noise(rng, height, width, 0.35 * pixels_per_metre, 5))
    marble = 0.16 * np.exp(-18 * veins**2) - 0.07 * noise(rng, height, width, max(2.0, 0.04 * pixels_per_metre), 2)
    canvas = to_image(
        np.where((shade > 0.2)[..., None], tint(first, 0.25 * shade - marble), tint(second, 0.2 * shade - marble))
    )
    for _ in range(int(2.5 * height * width / pixels_per_metre**2)):
        centre = tuple(int((rng.integers(1 + int(extent / side)) + 0.5) * side) for extent in (width, height))
        corners = cv2.ellipse2Poly(
            centre, (int(0.35 * side),) * 2, int(rng.integers(90)), 0, 360, int(rng.integers(30, 100))
        )
        cv2.fillPoly(canvas, [corners], random_colour(rng).tolist(), cv2.LINE_AA)
    canvas[joints] = (0.4 * first).astype(np.uint8)
    return canvas


def wood(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return planks along x with grain, knots and nail holes."""
    colour = np.array([rng.uniform(40, 100), rng.uniform(80, 140), rng.uniform(120, 200)], np.float32)
    plank = (pixels_per_metre * rng.uniform(0.09, 0.16), pixels_per_metre * rng.uniform(0.8, 1.6))
    shade, joints = _bond(rng, height, width, plank, 0.37, max(1.0, 0.005 * pixels_per_metre))
    squeezed = noise(rng, height, max(2, width // 8), max(2.0, 0.05 * pixels_per_metre), 3)
    bend = cv2.resize(squeezed, (width, height), interpolation=cv2.INTER_CUBIC)
    rings = 0.12 * np.sin(4.0 * bend + 9.0 * shade) + 0.06 * noise(rng, height, width, 3.0, 2)
    canvas = to_image(tint(colour, 0.22 * shade + rings))
    for _ in range(int(6 * height * width / pixels_per_metre**2)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        radius = pixels_per_metre * rng.uniform(0.01, 0.03)
        for part, darkness in ((1.0, 0.7), (0.6, 0.45), (0.25, 0.8)):
            axes = (max(1, int(1.6 * part * radius)), max(1, int(part * radius)))
            cv2.ellipse(canvas, centre, axes, 0, 0, 360, (darkness * colour).tolist(), -1, cv2.LINE_AA)
    canvas[joints] = (0.35 * colour).astype(np.uint8)
    return canvas


def stone(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return irregular stones with joints (the cells of random points) and grain."""
    seeds = np.full((height, width), 255, np.uint8)
    count = max(4, int(height * width / (pixels_per_metre * rng.uniform(0.12, 0.25)) ** 2))
    seeds[rng.integers(0, height, count), rng.integers(0, width, count)] = 0
    _, labels = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    colours = np.stack([random_colour(rng, 60, 190, 0.25) for _ in range(int(labels.max()) + 1)])
    edges = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    edges = cv2.dilate(edges.astype(np.uint8), np.ones((2, 2), np.uint8)) > 0
    relief = 0.14 * noise(rng, height, width, max(3.0, 0.1 * pixels_per_metre), 4)
    stones = colours[labels] * (1 + relief[..., None])
    return to_image(np.where(edges[..., None], 0.35 * stones, stones))


def carpet(rng: np.random.Generator, height: int, width: int, pixels_per_metre: float) -> Image:
    """Return a patterned carpet: warped stripes and dots with pile noise."""
    first, second, third = (random_colour(rng, 40, 190, 0.8) for _ in range(3))
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / np.float32(pixels_per_metre)
    angle = rng.uniform(0, np.pi)
    warp = 0.35 * noise(rng, height, width, 0.5 * pixels_per_metre, 2)
    stripes = np.sin(rng.uniform(14, 26) * (np.cos(angle) * x + np.sin(angle) * y) + warp * 6)
    blobs = noise(rng, height, width, 0.22 * pixels_per_metre, 3) > 0.9
    pile = 0.14 * noise(rng, height, width, 3.0, 2)
    ground = np.where((stripes > 0.2)[..., None], tint(first, pile), tint(second, pile))
    return to_image(np.where(blobs[..., None], tint(third, pile), ground))


WALLS: tuple[Surface, ...] = (brick, plaster, stone, tiles, wood)
FLOORS: tuple[Surface, ...] = (wood, tiles, stone, carpet)
