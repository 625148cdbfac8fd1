"""What stands along roads: carriageways, houses, trees, cars, lamps, signs, and the sky above.

Pictures that many things share are drawn once into a :class:`Stock`; fronts of houses and signs are all different.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import fittings, outdoors, plain, prints, textures
from seamark.datasets_synth.panels import Panel, Vector, box_faces
from seamark.datasets_synth.textures import Field, Image, noise, random_colour, tint, to_image
from seamark.datasets_synth.world import Lamp

FRONT_PIXELS_PER_METRE = 55.0
ROAD_PIXELS_PER_METRE = 60.0
STRIP_M = 12.0  # length of the pictures of a road
SKY_M = 350.0
LAMP_HEIGHT_M = 5.0
ZENITH, HORIZON = (205, 150, 95), (222, 212, 200)  # BGR of the sky
LAMP = (22.0, 21.0, 19.0)
UP = np.array([0.0, 0.0, 1.0])


def asphalt(rng: np.random.Generator, length_m: float, width_m: float, *, lane: bool) -> Image:
    """Return a piece of road along x, with grain, patches, cracks and perhaps the dashes of a middle line."""
    scale = ROAD_PIXELS_PER_METRE
    height, width = round(width_m * scale), round(length_m * scale)
    colour = np.array([96.0, 95.0, 93.0]) * rng.uniform(0.85, 1.15)
    relief = 0.045 * noise(rng, height, width, 3.0, 2) + 0.06 * noise(rng, height, width, 90, 4)
    canvas = to_image(tint(colour, relief))
    for _ in range(int(0.25 * length_m * width_m)):
        place, kind = (rng.uniform(0, 1, 2) * (width, height)).astype(int), int(rng.integers(3))
        shade = [float(rng.uniform(62, 122))] * 3
        if kind == 0:
            axes = (int(rng.uniform(3, 40)), int(rng.uniform(3, 20)))
            cv2.ellipse(canvas, place.tolist(), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
        elif kind == 1:
            path = np.cumsum(rng.normal(0, 7, (25, 2)) + rng.normal(0, 3, 2), axis=0) + place
            cv2.polylines(canvas, [path.astype(np.int32)], False, (52, 52, 52), 2, cv2.LINE_AA)
        else:
            end = place + (rng.uniform(0.2, 1.2, 2) * scale).astype(int)
            cv2.rectangle(canvas, place.tolist(), end.tolist(), shade, -1)
    if lane:
        middle, thick = height // 2, max(3, int(0.07 * scale))
        for start in np.arange(0, length_m, 6.0):
            ends = [int(start * scale), int((start + 3) * scale)]
            cv2.rectangle(canvas, (ends[0], middle - thick), (ends[1], middle + thick), (205, 210, 212), -1)
        for edge in (int(0.12 * scale), height - int(0.25 * scale)):
            canvas[edge : edge + thick] = (195, 200, 202)
    return canvas


def pavement(rng: np.random.Generator) -> Image:
    """Return slabs of a pavement, 6 m by 2 m."""
    return plain.slabs(rng, 140, 420, 70.0)


@dataclass(frozen=True, eq=False)
class CarPaint:
    """Pictures of a car in one paint: its body from the side and the end, its cabin, and the sheet on top."""

    side: Image
    end: Image
    cabin_side: Image
    cabin_end: Image
    top: Image


def _car_paint(rng: np.random.Generator) -> CarPaint:
    """Return a car: paint, wheels, a door, lights, a plate with a number; windows that mirror the sky."""
    colour = random_colour(rng, 30, 190, 0.7)
    side, end = (to_image(tint(colour, 0.05 * noise(rng, 60, width, 60, 2))) for width in (300, 120))
    side[48:] = (0.45 * side[48:]).astype(np.uint8)
    for x in (55, 240):
        cv2.circle(side, (x, 46), 26, (18, 18, 18), -1, cv2.LINE_AA)
        cv2.circle(side, (x, 46), 12, (150, 150, 155), -1, cv2.LINE_AA)
    for x in (110, 175, 215):
        cv2.line(side, (x, 2), (x, 46), (0.5 * colour).tolist(), 1, cv2.LINE_AA)
    cv2.rectangle(side, (160, 12), (170, 15), (40, 40, 40), -1)
    end[44:] = (0.5 * end[44:]).astype(np.uint8)
    for x in (8, 92):
        cv2.rectangle(end, (x, 14), (x + 20, 26), (60, 70, 200) if rng.random() < 0.5 else (210, 215, 215), -1)
    cv2.rectangle(end, (40, 28), (80, 40), (215, 218, 218), -1)
    prints.draw_text(rng, end, (42, 26, 36, 14), 12.0)
    glass = to_image(tint(np.array([110.0, 98.0, 88.0]), np.linspace(0.3, -0.5, 40)[:, None].repeat(160, axis=1)))
    cabin_side, cabin_end = glass.copy(), glass[:, :100].copy()
    for image in (cabin_side, cabin_end):
        cv2.rectangle(image, (0, 0), (image.shape[1] - 1, 39), colour.tolist(), 5)
    cv2.line(cabin_side, (85, 0), (85, 39), colour.tolist(), 6)
    top = to_image(tint(colour, 0.04 * noise(rng, 40, 60, 30, 2)))
    return CarPaint(side, end, cabin_side, cabin_end, top)


@dataclass(frozen=True, eq=False)
class Stock:
    """Pictures that many things share."""

    crowns: tuple[Image, ...]
    bark: Image
    cars: tuple[CarPaint, ...]
    walls: tuple[Image, ...]
    metal: Image
    white: Image
    under: Image


def stock(rng: np.random.Generator, leaves: np.random.Generator) -> Stock:
    """Return pictures drawn from ``rng``; those of leaves, which no wind leaves alone, from ``leaves``."""
    metal = to_image(tint(np.array([95.0, 100.0, 98.0]), 0.15 * noise(rng, 200, 24, 10, 3)))
    dark = cv2.GaussianBlur(np.pad(np.full((52, 132), 0.75, np.float32), 14), (0, 0), 7.0)
    return Stock(
        tuple(outdoors.foliage(leaves, 256, 256) for _ in range(6)),
        plain.muted(textures.wood(rng, 80, 200, 90.0).transpose(1, 0, 2), 0.35),
        tuple(_car_paint(rng) for _ in range(6)),
        tuple(fittings.front(rng, 540, 440, FRONT_PIXELS_PER_METRE) for _ in range(4)),
        metal,
        np.full((8, 8, 3), 235, np.uint8),
        to_image(tint(np.array([96.0, 95.0, 93.0]), -dark)),
    )


def strips(points: NDArray[np.float64], widths: tuple[float, float], z: float, images: list[Image]) -> list[Panel]:
    """Return a band along the polyline (N, 2), from ``widths[0]`` to ``widths[1]`` m left of it, pictures in turn."""
    panels = []
    lap = _overlap(points, max(abs(width) for width in widths)) if len(points) > 2 else 0.0
    for number, (a, b) in enumerate(pairwise(points)):
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        left = np.array([-along[1], along[0]])
        corner = np.array([*(a - lap * along + widths[1] * left), z + 0.004 * (number % 2)])
        right = np.array([*((length + 2 * lap) * along), 0.0])
        down = np.array([*((widths[0] - widths[1]) * left), 0.0])
        panels.append(Panel(corner, right, down, images[number % len(images)], tiles=(length / STRIP_M, 1.0)))
    return panels


def _overlap(points: NDArray[np.float64], most_aside: float) -> float:
    """Return by how many m neighbours must overlap so that no gap is left outside the sharpest bend."""
    headings = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    return float(most_aside * np.tan(np.abs(np.diff(headings)).max() / 2) + 0.02)


def house(
    rng: np.random.Generator, things: Stock, front: Vector, facing: float, size: tuple[float, float, float]
) -> list[Panel]:
    """Return a house: ``front`` (3,) is the foot of the middle of its front, which looks along the yaw ``facing``.

    ``size`` is the depth, the width of the front and the height in m.
    """
    depth, width, height = size
    back = np.array([np.cos(facing), np.sin(facing), 0.0])
    faces = box_faces(front - back * depth / 2 + UP * height / 2, np.array([depth, width, height]), facing)
    shape = (round(height * FRONT_PIXELS_PER_METRE), round(width * FRONT_PIXELS_PER_METRE))
    sides = things.walls[int(rng.integers(len(things.walls)))]
    panels = [Panel(*faces[0], fittings.front(rng, *shape, FRONT_PIXELS_PER_METRE))]
    panels += [Panel(*face, sides) for face in faces[1:4]]
    panels.append(Panel(*faces[4], things.metal))
    return panels


def tree(rng: np.random.Generator, things: Stock, foot: Vector) -> list[Panel]:
    """Return a tree: a trunk, and a crown of boxes of many sizes turned against each other."""
    tall, thick = rng.uniform(2.2, 3.2), rng.uniform(0.2, 0.4)
    panels = [Panel(*face, things.bark) for face in box_faces(foot + UP * tall / 2, np.array([thick, thick, tall]))[:4]]
    spread = rng.uniform(1.3, 2.2)
    centre = foot + UP * (tall + 0.75 * spread)
    for number, share in enumerate((1.25, 0.85, 0.8, 0.75, 0.7, 0.65)):
        angle = 2.4 * number + rng.uniform(0, 0.6)
        away = 0.0 if number == 0 else rng.uniform(0.45, 0.7) * spread
        lift = 0.0 if number == 0 else rng.uniform(-0.45, 0.75) * spread
        place = centre + np.array([away * np.cos(angle), away * np.sin(angle), lift])
        size = spread * share * np.array([1.0, 1.0, rng.uniform(0.75, 1.0)])
        crown = things.crowns[int(rng.integers(len(things.crowns)))]
        panels += [Panel(*face, crown) for face in box_faces(place, size, float(rng.uniform(0, np.pi)))]
    return panels


def car(rng: np.random.Generator, things: Stock, foot: Vector, yaw: float, *, on_asphalt: bool = True) -> list[Panel]:
    """Return a parked car: a body, a cabin that shines, and on asphalt the dark beneath it."""
    paint = things.cars[int(rng.integers(len(things.cars)))]
    length, high = rng.uniform(3.8, 4.5), rng.uniform(0.72, 0.85)
    body = box_faces(foot + UP * (0.15 + high / 2), np.array([length, 1.7, high]), yaw)
    back = 0.25 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    cabin = box_faces(foot - back + UP * (0.15 + high + 0.27), np.array([0.52 * length, 1.45, 0.54]), yaw)
    pictures = (paint.end, paint.side, paint.end, paint.side)
    panels = [Panel(*face, image, gloss=0.5) for face, image in zip(body, pictures, strict=False)]
    pictures = (paint.cabin_end, paint.cabin_side, paint.cabin_end, paint.cabin_side)
    panels += [Panel(*face, image, gloss=0.8) for face, image in zip(cabin, pictures, strict=False)]
    panels += [Panel(*face, paint.top, gloss=0.5) for face in (body[4], cabin[4])]
    if not on_asphalt:
        return panels
    shadow = box_faces(foot + UP * 0.01, np.array([length + 0.9, 2.5, 0.02]), yaw)[4]
    return [*panels, Panel(*shadow, things.under)]


def street_lamp(things: Stock, foot: Vector, towards: Vector) -> tuple[list[Panel], Lamp]:
    """Return a lamp on a post that reaches out along the unit vector ``towards`` (3,)."""
    post = box_faces(foot + UP * LAMP_HEIGHT_M / 2, np.array([0.14, 0.14, LAMP_HEIGHT_M]))[:4]
    panels = [Panel(*face, things.metal) for face in post]
    head = foot + UP * LAMP_HEIGHT_M + 0.8 * towards
    yaw = float(np.arctan2(towards[1], towards[0]))
    panels += [Panel(*face, things.metal) for face in box_faces(head, np.array([1.6, 0.2, 0.1]), yaw)]
    across = np.array([-towards[1], towards[0], 0.0])
    below = head - 0.07 * UP + 0.5 * towards
    panels.append(Panel(below - 0.35 * towards - 0.12 * across, 0.7 * towards, 0.24 * across, things.white, glow=1.0))
    panels.append(Panel(below - 0.35 * towards + 0.12 * across, 0.7 * towards, -0.24 * across, things.white, glow=1.0))
    return panels, Lamp(head - 0.5 * UP, LAMP)


def sign(rng: np.random.Generator, things: Stock, foot: Vector, facing: float) -> list[Panel]:
    """Return a sign on a post that looks along the yaw ``facing``."""
    height, width = rng.uniform(0.6, 1.2), rng.uniform(0.6, 1.8)
    panels = [
        Panel(*face, things.metal) for face in box_faces(foot + UP * 0.9, np.array([0.09, 0.09, 1.8]), facing)[:4]
    ]
    board = box_faces(foot + UP * (1.7 + height / 2), np.array([0.05, width, height]), facing)
    panels.append(Panel(*board[0], prints.poster(rng, round(height * 110), round(width * 110))))
    panels.append(Panel(*board[2], things.metal))
    return panels


def _round_noise(rng: np.random.Generator, height: int, width: int, cell_px: float, octaves: int) -> Field:
    """Return noise (height, width) that goes on without a seam from the right edge to the left."""
    overlap = width // 8
    values = noise(rng, height, width + overlap, cell_px, octaves)
    share = np.linspace(0, 1, overlap, dtype=np.float32)
    values[:, :overlap] = share * values[:, :overlap] + (1 - share) * values[:, width:]
    return values[:, :width]


def _panorama(rng: np.random.Generator, clouds: np.random.Generator, height: int, width: int) -> Image:
    """Return the sky all round: clouds that thin out upwards, above far hills."""
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    blue = np.array(ZENITH, np.float32) * (1 - y) + np.array(HORIZON, np.float32) * y
    cloud = _round_noise(clouds, height, width, height / 2, 6)[..., None] * np.clip(4 * y, 0, 1)
    canvas = blue + np.clip(0.8 * cloud, 0, 1) * (np.array([240.0, 240.0, 240.0]) - blue)
    rows = np.arange(height, dtype=np.float32)[:, None]
    for far in (0.80, 0.85, 0.9):
        ridge = height * (far + 0.03 * _round_noise(rng, 1, width, width / 30, 5))
        relief = 0.16 * _round_noise(rng, height, width, 30, 5)
        hill = tint(np.array([70.0, 105.0, 85.0]) * (1.9 - far), relief)
        canvas = np.where((rows > ridge)[..., None], hill, canvas)
    return to_image(canvas)


def sky(rng: np.random.Generator, clouds: np.random.Generator, centre: tuple[float, float]) -> list[Panel]:
    """Return four sides and a top far away, which shine with daylight; clouds come from their own generator."""
    x, y = centre
    corners = [np.array([x + SKY_M * a, y + SKY_M * b, 0.8 * SKY_M]) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    panorama = _panorama(rng, clouds, 512, 4096)
    panels = []
    for number, side in enumerate(np.split(panorama, 4, axis=1)):
        a, b = corners[number], corners[(number + 1) % 4]
        panels.append(Panel(a, b - a, -0.9 * SKY_M * UP, np.ascontiguousarray(side), 1.0, True))
    top = np.full((8, 8, 3), ZENITH, np.uint8)
    panels.append(Panel(corners[3], np.array([2 * SKY_M, 0, 0]), np.array([0, 2 * SKY_M, 0]), top, 1.0, True))
    return panels
