"""Procedural pictures of what stands outdoors: foliage, branches, building facades, hills.

Same manners as :mod:`seamark.datasets_synth.textures`: a random generator and a size in, BGR uint8 (height, width, 3)
out.
"""

import cv2
import numpy as np

from seamark.datasets_synth import prints, textures
from seamark.datasets_synth.textures import Image, noise, random_colour, tint, to_image


def leaf_colour(rng: np.random.Generator) -> list[float]:
    """Return a BGR colour between dark green and autumn."""
    brightness = rng.uniform(0.25, 1.2)
    return [brightness * rng.uniform(10, 90), brightness * rng.uniform(90, 170), brightness * rng.uniform(30, 170)]


def draw_leaves(
    rng: np.random.Generator, canvas: Image, centre: tuple[float, float], spread: float, count: int
) -> None:
    """Draw ``count`` leaves about ``centre``, the later ones brighter and on top, in place."""
    length = spread * float(rng.uniform(0.05, 0.14)) + 2
    places = rng.normal(0, 0.45 * spread, (count, 2)) * (1.0, 0.8) + centre
    tilts = rng.normal(rng.uniform(0, 180), 50, count)
    for place, tilt in zip(places.astype(int), tilts, strict=True):
        axes = (max(1, int(length * rng.uniform(0.5, 1.2))), max(1, int(length * rng.uniform(0.15, 0.5))))
        cv2.ellipse(canvas, place.tolist(), axes, float(tilt), 0, 360, leaf_colour(rng), -1, cv2.LINE_AA)


def draw_branch(
    rng: np.random.Generator, canvas: Image, start: tuple[float, float], angle: float, length: float
) -> None:
    """Draw a tree without leaves: every branch ends in two or three thinner ones, in place."""
    end = (start[0] + length * np.cos(angle), start[1] - length * np.sin(angle))
    shade = rng.uniform(20, 70)
    ends = [(int(x), int(y)) for x, y in (start, end)]
    cv2.line(canvas, ends[0], ends[1], [0.7 * shade, 0.85 * shade, shade], max(1, int(length / 9)), cv2.LINE_AA)
    if length < 6:
        return
    for turn in rng.uniform(-0.8, 0.8, int(rng.integers(2, 4))):
        draw_branch(rng, canvas, end, angle + turn, length * rng.uniform(0.55, 0.78))


def foliage(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a hedge or the crown of a tree that fills the picture."""
    ground = tint(np.array([30, 60, 45]), 0.4 * noise(rng, height, width, max(4, width / 8), 5))
    canvas = to_image(ground)
    for _ in range(int(rng.integers(1, 4))):
        draw_branch(rng, canvas, (rng.uniform(0, width), height), rng.uniform(1.1, 2.0), 0.25 * height)
    for _ in range(int(rng.integers(10, 26))):
        centre = (rng.uniform(0, width), rng.uniform(0, height))
        draw_leaves(rng, canvas, centre, rng.uniform(0.08, 0.3) * width, int(rng.integers(25, 90)))
    return canvas


def grass(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a meadow or gravel from above: fine noise, blades, stones."""
    green = rng.random() < 0.6
    colour = np.array(leaf_colour(rng)) if green else random_colour(rng, 80, 170, 0.2)
    fine = 0.3 * noise(rng, height, width, rng.uniform(4, 14), 3)
    canvas = to_image(tint(colour, fine + 0.2 * noise(rng, height, width, width / 4, 3)))
    for place in rng.uniform(0, 1, (int(rng.integers(100, 500)), 2)) * (width, height):
        shade = (rng.uniform(0.5, 1.6) * colour).clip(0, 255).tolist()
        x, y = int(place[0]), int(place[1])
        if green:
            tip = (x + int(rng.normal(0, 4)), y - int(rng.integers(4, 16)))
            cv2.line(canvas, (x, y), tip, shade, 1, cv2.LINE_AA)
        else:
            axes = (int(rng.integers(1, 7)), int(rng.integers(1, 5)))
            cv2.ellipse(canvas, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    return canvas


def _draw_window(rng: np.random.Generator, canvas: Image, box: tuple[int, int, int, int], frame: list[float]) -> None:
    """Draw one window (x, y, width, height): frame, reflecting glass, bars, perhaps a blind or a sill."""
    x, y, width, height = box
    glass = prints.gradient(rng, height, width) * 0.6 if rng.random() < 0.5 else np.full((height, width, 3), 40.0)
    canvas[y : y + height, x : x + width] = to_image(glass)
    if rng.random() < 0.4:
        blind = int(height * rng.uniform(0.2, 0.9))
        canvas[y : y + blind, x : x + width] = to_image(
            np.broadcast_to(random_colour(rng, 90, 230, 0.4), (blind, width, 3))
        )
        canvas[y : y + blind : 4, x : x + width] //= 2
    thick = max(1, width // 14)
    cv2.rectangle(canvas, (x, y), (x + width, y + height), frame, thick, cv2.LINE_AA)
    for part in np.arange(1, int(rng.integers(1, 4))) / 2:
        cv2.line(canvas, (x + int(part * width), y), (x + int(part * width), y + height), frame, thick)
    if rng.random() < 0.5:
        cv2.line(canvas, (x, y + int(0.4 * height)), (x + width, y + int(0.4 * height)), frame, thick)
    cv2.line(canvas, (x - thick, y + height + thick), (x + width + thick, y + height + thick), frame, 2 * thick)


def facade(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the front of a building: storeys of windows that differ in blinds and glass, shops on the ground floor."""
    surface = (textures.plaster, textures.brick, textures.stone)[int(rng.integers(3))]
    canvas = surface(rng, height, width, rng.uniform(35, 80))
    columns, storeys = int(rng.integers(3, 9)), int(rng.integers(2, 7))
    pitch_x, pitch_y = width / columns, 0.82 * height / storeys
    size = (int(pitch_x * rng.uniform(0.35, 0.7)), int(pitch_y * rng.uniform(0.4, 0.75)))
    frame = random_colour(rng, 20, 240, 0.4).tolist()
    for storey in range(storeys):
        for column in range(columns):
            corner = (int((column + 0.5) * pitch_x - size[0] / 2), int((storey + 0.5) * pitch_y - size[1] / 2))
            _draw_window(rng, canvas, (*corner, max(4, size[0]), max(4, size[1])), frame)
    shop = int(0.82 * height)
    for left in range(0, width, max(24, width // 4)):
        span = min(width, left + max(24, width // 4)) - left
        if span > 16 and rng.random() < 0.7:
            canvas[shop:, left : left + span] = prints.poster(rng, height - shop, span)
    return canvas


def hills(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a landscape with clouds, ridges, meadow and trees."""
    canvas = prints.picture(rng, height, width)
    for _ in range(int(rng.integers(2, 9))):
        foot = (rng.uniform(0, width), rng.uniform(0.5, 1.0) * height)
        tall = rng.uniform(0.08, 0.35) * height
        if rng.random() < 0.5:
            draw_branch(rng, canvas, foot, np.pi / 2, 0.35 * tall)
        draw_leaves(rng, canvas, (foot[0], foot[1] - tall), 0.7 * tall, int(rng.integers(60, 200)))
    return canvas
