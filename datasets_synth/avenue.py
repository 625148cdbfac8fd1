"""What stands along roads: carriageways, houses, trees, cars, lamps, signs, and the sky above.

Pictures that many things share are drawn once into a :class:`Stock`; fronts of houses and signs are all different.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import outdoors, prints, textures
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
    relief = 0.13 * noise(rng, height, width, 3.0, 2) + 0.08 * noise(rng, height, width, 90, 4)
    canvas = to_image(tint(colour, relief))
    for _ in range(int(0.35 * length_m * width_m)):
        place, kind = (rng.uniform(0, 1, 2) * (width, height)).astype(int), int(rng.integers(3))
        shade = [float(rng.uniform(40, 150))] * 3
        if kind == 0:
            axes = (int(rng.uniform(3, 40)), int(rng.uniform(3, 20)))
            cv2.ellipse(canvas, place.tolist(), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
        elif kind == 1:
            path = np.cumsum(rng.normal(0, 7, (25, 2)) + rng.normal(0, 3, 2), axis=0) + place
            cv2.polylines(canvas, [path.astype(np.int32)], False, (35, 35, 35), 2, cv2.LINE_AA)
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
    return prints.add_stickers(rng, textures.tiles(rng, 140, 420, 70.0), 70.0, 2.0)


def _car_side(rng: np.random.Generator) -> Image:
    """Return the side of a parked car: paint, windows, wheels, a door, a mark."""
    canvas = to_image(tint(random_colour(rng, 20, 220, 1.2), 0.12 * noise(rng, 110, 300, 60, 3)))
    cv2.rectangle(canvas, (45, 8), (255, 48), (45, 40, 35), -1)
    cv2.rectangle(canvas, (145, 8), (155, 100), (30, 30, 30), 2)
    for x in (55, 240):
        cv2.circle(canvas, (x, 92), 22, (20, 20, 20), -1, cv2.LINE_AA)
        cv2.circle(canvas, (x, 92), 10, (170, 170, 175), -1, cv2.LINE_AA)
    prints.draw_text(rng, canvas, (80, 52, 130, 20), 18.0)
    return canvas


@dataclass(frozen=True, eq=False)
class Stock:
    """Pictures that many things share."""

    crowns: tuple[Image, ...]
    bark: Image
    cars: tuple[Image, ...]
    walls: tuple[Image, ...]
    metal: Image
    white: Image


def stock(rng: np.random.Generator) -> Stock:
    """Return pictures drawn from ``rng``."""
    metal = to_image(tint(np.array([95.0, 100.0, 98.0]), 0.15 * noise(rng, 200, 24, 10, 3)))
    return Stock(
        tuple(outdoors.foliage(rng, 256, 256) for _ in range(5)),
        textures.wood(rng, 80, 200, 90.0).transpose(1, 0, 2).copy(),
        tuple(_car_side(rng) for _ in range(6)),
        tuple(outdoors.facade(rng, 360, 440) for _ in range(4)),
        metal,
        np.full((8, 8, 3), 235, np.uint8),
    )


def strips(points: NDArray[np.float64], widths: tuple[float, float], z: float, images: list[Image]) -> list[Panel]:
    """Return a band along the polyline (N, 2), from ``widths[0]`` to ``widths[1]`` m left of it, pictures in turn."""
    panels = []
    for number, (a, b) in enumerate(pairwise(points)):
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        left = np.array([-along[1], along[0]])
        lap = 0.02 * (widths[1] - widths[0]) if len(points) > 2 else 0.0  # neighbours overlap where the road bends
        corner = np.array([*(a - lap * along + widths[1] * left), z + 0.004 * (number % 2)])
        right = np.array([*((length + 2 * lap) * along), 0.0])
        down = np.array([*((widths[0] - widths[1]) * left), 0.0])
        panels.append(Panel(corner, right, down, images[number % len(images)], tiles=(length / STRIP_M, 1.0)))
    return panels


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
    panels = [Panel(*faces[0], outdoors.facade(rng, *shape))]
    panels += [Panel(*face, sides) for face in faces[1:4]]
    panels.append(Panel(*faces[4], things.metal))
    return panels


def tree(rng: np.random.Generator, things: Stock, foot: Vector) -> list[Panel]:
    """Return a tree: a trunk, and a crown of boxes turned against each other."""
    tall, thick = rng.uniform(1.8, 2.8), rng.uniform(0.2, 0.4)
    panels = [Panel(*face, things.bark) for face in box_faces(foot + UP * tall / 2, np.array([thick, thick, tall]))[:4]]
    spread, yaw = rng.uniform(1.6, 3.0), rng.uniform(0, np.pi)
    for number, share in enumerate((1.0, 0.85, 0.6)):
        size = np.array([spread * share, spread * share, 0.75 * spread])
        centre = foot + UP * (tall + 0.3 * spread * (2 * number + 0.6))
        crown = things.crowns[int(rng.integers(len(things.crowns)))]
        panels += [Panel(*face, crown) for face in box_faces(centre, size, yaw + 0.7 * number)]
    return panels


def car(rng: np.random.Generator, things: Stock, foot: Vector, yaw: float) -> list[Panel]:
    """Return a parked car."""
    side = things.cars[int(rng.integers(len(things.cars)))]
    size = np.array([rng.uniform(3.6, 4.4), 1.7, rng.uniform(1.4, 1.6)])
    faces = box_faces(foot + UP * (0.12 + size[2] / 2), size, yaw)
    return [Panel(*face, side) for face in faces[:4]] + [Panel(*faces[4], things.metal)]


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


def _panorama(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the sky all round: clouds that thin out upwards, above far hills."""
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    blue = np.array(ZENITH, np.float32) * (1 - y) + np.array(HORIZON, np.float32) * y
    cloud = _round_noise(rng, height, width, height / 2, 6)[..., None] * np.clip(4 * y, 0, 1)
    canvas = blue + np.clip(0.8 * cloud, 0, 1) * (np.array([240.0, 240.0, 240.0]) - blue)
    rows = np.arange(height, dtype=np.float32)[:, None]
    for far in (0.80, 0.85, 0.9):
        ridge = height * (far + 0.03 * _round_noise(rng, 1, width, width / 30, 5))
        relief = 0.16 * _round_noise(rng, height, width, 30, 5)
        hill = tint(np.array([70.0, 105.0, 85.0]) * (1.9 - far), relief)
        canvas = np.where((rows > ridge)[..., None], hill, canvas)
    return to_image(canvas)


def sky(rng: np.random.Generator, centre: tuple[float, float]) -> list[Panel]:
    """Return four sides and a top far away, which shine with daylight."""
    x, y = centre
    corners = [np.array([x + SKY_M * a, y + SKY_M * b, 0.8 * SKY_M]) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    panorama = _panorama(rng, 512, 4096)
    panels = []
    for number, side in enumerate(np.split(panorama, 4, axis=1)):
        a, b = corners[number], corners[(number + 1) % 4]
        panels.append(Panel(a, b - a, -0.9 * SKY_M * UP, np.ascontiguousarray(side), 1.0, True))
    top = np.full((8, 8, 3), ZENITH, np.uint8)
    panels.append(Panel(corners[3], np.array([2 * SKY_M, 0, 0]), np.array([0, 2 * SKY_M, 0]), top, 1.0, True))
    return panels
