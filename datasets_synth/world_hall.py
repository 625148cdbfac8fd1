"""The world ``hall``: large, painted in one colour, with few things to hold on to."""

import cv2
import numpy as np

from seamark.datasets_synth import prints
from seamark.datasets_synth.clutter import change
from seamark.datasets_synth.floor_plan import Space
from seamark.datasets_synth.panels import Panel, box_faces, pixels
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.textures import Image, noise, tint, to_image
from seamark.datasets_synth.world import Lamp, World

SPACE = Space(-15.0, 15.0, -10.0, 10.0, 5.0)
WALL_PIXELS_PER_METRE = 70.0
FLOOR_PIXELS_PER_METRE = 60.0
POST_PIXELS_PER_METRE = 120.0
EYE_M = 1.2
SIGNS_PER_WALL = 2
POSTS = ((-5.0, -2.2), (5.0, -2.2), (-5.0, 2.2), (5.0, 2.2))
CRATES = 4


def hall_route(_: str) -> Route:
    """Return a lap between the posts and the walls."""
    waypoints = np.array([[-10.5, -6, EYE_M], [10.5, -6, EYE_M], [10.5, 6, EYE_M], [-10.5, 6, EYE_M]])
    return Route("lap", waypoints, True, 2.5, 1.6, 1.5)


def _paint(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a painted wall: faint stains, a darker skirting, a few scuffs low down."""
    colour = np.array([rng.uniform(165, 200), rng.uniform(170, 205), rng.uniform(170, 205)])
    relief = 0.025 * noise(rng, height, width, 200, 3) + 0.012 * noise(rng, height, width, 6, 2)
    canvas = to_image(tint(colour, relief))
    skirting = int(height - 0.12 * WALL_PIXELS_PER_METRE)
    canvas[skirting:] = canvas[skirting:] // 2
    for _ in range(int(width / WALL_PIXELS_PER_METRE)):
        x, y = int(rng.integers(width)), int(height - rng.uniform(0.15, 0.7) * WALL_PIXELS_PER_METRE)
        end = (x + int(rng.normal(0, 14)), y + int(rng.normal(0, 4)))
        cv2.line(canvas, (x, y), end, (0.75 * colour).tolist(), int(rng.integers(1, 3)), cv2.LINE_AA)
    return canvas


def _concrete(rng: np.random.Generator, height: int, width: int, joint_m: float) -> Image:
    """Return a concrete slab with joints, faint blotches and a few stains."""
    relief = 0.05 * noise(rng, height, width, 150, 3) + 0.035 * noise(rng, height, width, 8, 3)
    canvas = to_image(tint(np.array([140, 146, 148]), relief))
    pitch = joint_m * FLOOR_PIXELS_PER_METRE
    for x in np.arange(pitch, width, pitch).astype(int).tolist():
        cv2.line(canvas, (x, 0), (x, height), (95, 98, 100), 2)
    for y in np.arange(pitch, height, pitch).astype(int).tolist():
        cv2.line(canvas, (0, y), (width, y), (95, 98, 100), 2)
    for _ in range(int(0.12 * height * width / FLOOR_PIXELS_PER_METRE**2)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.uniform(3, 30)), int(rng.uniform(3, 20)))
        shade = rng.uniform(90, 170)
        cv2.ellipse(canvas, centre, axes, float(rng.uniform(0, 180)), 0, 360, [shade] * 3, -1, cv2.LINE_AA)
    return canvas


def _walls(rng: np.random.Generator) -> list[Panel]:
    panels = []
    for left, right in SPACE.sides():
        edge, down = right - left, np.array([0.0, 0.0, -SPACE.height])
        image = _paint(rng, pixels(down, WALL_PIXELS_PER_METRE), pixels(edge, WALL_PIXELS_PER_METRE))
        length = float(np.linalg.norm(edge))
        for share in (np.arange(SIGNS_PER_WALL) + rng.uniform(0.2, 0.8, SIGNS_PER_WALL)) / SIGNS_PER_WALL:
            height, width = (int(rng.uniform(0.7, 1.4) * WALL_PIXELS_PER_METRE) for _ in range(2))
            row = int((SPACE.height - rng.uniform(1.8, 2.6)) * WALL_PIXELS_PER_METRE)
            column = int(min(share, 1 - 1.6 / length) * image.shape[1])
            image[row : row + height, column : column + width] = prints.poster(rng, height, width)
        panels.append(Panel(left - down, edge, down, image))
    return panels


def _post(rng: np.random.Generator, x: float, y: float) -> list[Panel]:
    """Return a pillar with warning stripes at its foot and a number."""
    panels = []
    for corner, right, down in box_faces(np.array([x, y, SPACE.height / 2]), np.array([0.5, 0.5, SPACE.height]))[:4]:
        height, width = pixels(down, POST_PIXELS_PER_METRE), pixels(right, POST_PIXELS_PER_METRE)
        image = _paint(rng, height, width)
        stripes = image[int(0.72 * height) :]
        rows, columns = np.mgrid[0 : len(stripes), 0:width]
        stripes[(rows + columns) % 44 < 22] = (30, 190, 225)
        sign = prints.poster(rng, width, width)
        image[int(0.56 * height) :][:width] = sign
        panels.append(Panel(corner, right, down, image))
    return panels


def _crates(rng: np.random.Generator, seed: int, run: int) -> list[Panel]:
    panels = []
    for number in range(CRATES):
        became = change(seed, run, number)
        size = rng.uniform((0.7, 0.7, 0.6), (1.3, 1.1, 1.5))
        x, y = rng.uniform(-12, 12) + became.along_m, rng.choice([-8.9, 8.9])
        yaw = rng.uniform(-0.5, 0.5) + became.turn_rad
        for corner, right, down in box_faces(np.array([x, y, size[2] / 2]), size, yaw):
            image = prints.carton(rng, pixels(down, 100), pixels(right, 100))
            if became.present:
                panels.append(Panel(corner, right, down, image))
    return panels


def build_hall(_: str, seed: int, run: int = 0) -> World:
    """Return the world; ``run`` moves a few crates."""
    rng = np.random.default_rng([seed, 0x4A11])
    across, deep = np.array([SPACE.east - SPACE.west, 0, 0]), np.array([0, SPACE.north - SPACE.south, 0])
    shape = (pixels(deep, FLOOR_PIXELS_PER_METRE), pixels(across, FLOOR_PIXELS_PER_METRE))
    floor = Panel(np.array([SPACE.west, SPACE.north, 0.0]), across, -deep, _concrete(rng, *shape, 5.0))
    above = _concrete(rng, shape[0] // 2, shape[1] // 2, 1.25)
    ceiling = Panel(np.array([SPACE.west, SPACE.south, SPACE.height]), across, deep, above)
    panels = [*_walls(rng), floor, ceiling, *_crates(rng, seed, run)]
    for x, y in POSTS:
        panels += _post(rng, x, y)
    lamps = []
    for x in (-10.0, 0.0, 10.0):
        for y in (-5.0, 5.0):
            corner = np.array([x - 0.9, y - 0.15, SPACE.height - 0.02])
            white = np.full((8, 8, 3), 235, np.uint8)
            panels.append(Panel(corner, np.array([1.8, 0, 0]), np.array([0, 0.3, 0]), white, glow=1.0))
            lamps.append(Lamp(np.array([x, y, SPACE.height - 0.8]), (6.0, 5.8, 5.4)))
    return World(tuple(panels), tuple(lamps), (0.45, 0.45, 0.47))
