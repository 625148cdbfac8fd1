"""From a floor plan (rectangles that touch) to walls, floors, ceilings, furniture and lamps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import prints, textures
from seamark.datasets_synth.panels import Panel, Vector, box_faces, pixels
from seamark.datasets_synth.textures import Image
from seamark.datasets_synth.world import Lamp

WALL_PIXELS_PER_METRE = 150.0
GROUND_PIXELS_PER_METRE = 110.0
CLEARANCE_M = 0.75  # between the path and anything that stands on the floor
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Space:
    """A room or corridor: x from ``west`` to ``east``, y from ``south`` to ``north`` (m), open to its neighbours."""

    west: float
    east: float
    south: float
    north: float
    height: float

    @staticmethod
    def about(x: float, y: float, size_x: float, size_y: float, height: float) -> "Space":
        """Return the space of the given size about (x, y)."""
        return Space(x - size_x / 2, x + size_x / 2, y - size_y / 2, y + size_y / 2, height)

    def sides(self) -> list[tuple[Vector, Vector]]:
        """Return (left, right) lower corners (3,) of the four walls as seen from inside: north, east, south, west."""
        nw, ne = np.array([self.west, self.north, 0]), np.array([self.east, self.north, 0])
        sw, se = np.array([self.west, self.south, 0]), np.array([self.east, self.south, 0])
        return [(nw, ne), (ne, se), (se, sw), (sw, nw)]


def _openings(left: Vector, right: Vector, others: list[Space]) -> list[tuple[float, float, float]]:
    """Return (start, end, height) along the wall from ``left`` to ``right`` where other spaces touch it, in order."""
    along = right - left
    length = float(np.linalg.norm(along))
    axis = int(np.argmax(np.abs(along)))
    found = []
    for space in others:
        low, high = np.array([space.west, space.south]), np.array([space.east, space.north])
        if min(abs(low[1 - axis] - left[1 - axis]), abs(high[1 - axis] - left[1 - axis])) > 1e-6:
            continue
        ends = sorted(((edge - left[axis]) * np.sign(along[axis])) for edge in (low[axis], high[axis]))
        start, end = max(0.0, ends[0]), min(length, ends[1])
        if end - start > 0.1:
            found.append((start, end, space.height))
    return sorted(found)


def _wall_picture(rng: np.random.Generator, length: float, height: float) -> Image:
    """Return a wall with a surface, stickers, and a poster, picture or notice about every 1.3 m."""
    surface = textures.WALLS[int(rng.integers(len(textures.WALLS)))]
    shape = (max(8, round(height * WALL_PIXELS_PER_METRE)), max(8, round(length * WALL_PIXELS_PER_METRE)))
    image = surface(rng, *shape, WALL_PIXELS_PER_METRE)
    image = prints.add_stickers(rng, image, WALL_PIXELS_PER_METRE, 3.0)
    reach = rng.uniform(0.1, 0.6)
    while reach < length - 0.7 and height > 1.5:
        size = (min(rng.uniform(0.4, 1.3), length - reach - 0.1), rng.uniform(0.4, 1.2))
        width_px, height_px = (round(extent * WALL_PIXELS_PER_METRE) for extent in size)
        row = round((height - rng.uniform(max(1.5, size[1] + 0.2), height - 0.1)) * WALL_PIXELS_PER_METRE)
        column = round(reach * WALL_PIXELS_PER_METRE)
        picture = prints.poster(rng, height_px, width_px)
        target = image[row : row + height_px, column : column + width_px]
        target[:] = picture[: target.shape[0], : target.shape[1]]
        reach += size[0] + rng.uniform(0.2, 1.2)
    return image


def walls(rng: np.random.Generator, space: Space, others: list[Space]) -> list[Panel]:
    """Return the walls of a space, leaving out where others touch it, with the piece above a lower opening."""
    panels = []
    for left, right in space.sides():
        length = float(np.linalg.norm(right - left))
        along = (right - left) / length
        pieces, start = [], 0.0
        for begin, end, opening_height in _openings(left, right, others):
            pieces.append((start, begin, 0.0))
            if opening_height < space.height:
                pieces.append((begin, end, opening_height))
            start = end
        pieces.append((start, length, 0.0))
        for begin, end, bottom in pieces:
            if end - begin > 0.02:
                image = _wall_picture(rng, end - begin, space.height - bottom)
                corner = left + begin * along + space.height * UP
                panels.append(Panel(corner, (end - begin) * along, -(space.height - bottom) * UP, image))
    return panels


def floor_and_ceiling(rng: np.random.Generator, space: Space) -> list[Panel]:
    """Return the floor, the ceiling, and the bright panels of the lamps."""
    across, deep = np.array([space.east - space.west, 0, 0]), np.array([0, space.north - space.south, 0])
    shape = (pixels(deep, GROUND_PIXELS_PER_METRE), pixels(across, GROUND_PIXELS_PER_METRE))
    surface = textures.FLOORS[int(rng.integers(len(textures.FLOORS)))]
    ground = prints.add_stickers(rng, surface(rng, *shape, GROUND_PIXELS_PER_METRE), GROUND_PIXELS_PER_METRE, 2.0)
    sky = prints.add_stickers(rng, textures.plaster(rng, *shape, GROUND_PIXELS_PER_METRE), GROUND_PIXELS_PER_METRE, 1.0)
    floor = Panel(np.array([space.west, space.north, 0.0]), across, -deep, ground)
    ceiling = Panel(np.array([space.west, space.south, space.height]), across, deep, sky)
    return [floor, ceiling]


def lamps(rng: np.random.Generator, space: Space, spacing_m: float = 7.0) -> tuple[list[Panel], list[Lamp]]:
    """Return the lamps under the ceiling, few because the shader adds up ten at most: bright panels and light."""
    panels, lights = [], []
    columns = max(1, round((space.east - space.west) / spacing_m))
    rows = max(1, round((space.north - space.south) / spacing_m))
    warmth = rng.uniform(0.75, 1.0)
    for column in range(columns):
        for row in range(rows):
            x = space.west + (column + 0.5) * (space.east - space.west) / columns
            y = space.south + (row + 0.5) * (space.north - space.south) / rows
            image = np.full((8, 8, 3), 235, np.uint8)
            corner = np.array([x - 0.3, y - 0.12, space.height - 0.02])
            panels.append(Panel(corner, np.array([0.6, 0, 0]), np.array([0, 0.24, 0]), image, glow=1.0))
            power = rng.uniform(1.5, 2.0)
            colour = (power, power * (0.5 + 0.5 * warmth), power * warmth)
            lights.append(Lamp(np.array([x, y, space.height - 0.8]), colour))
    return panels, lights


def _box(rng: np.random.Generator, centre: Vector, size: Vector, yaw: float) -> list[Panel]:
    """Return a piece of furniture: a book shelf if tall, else a crate or a covered table."""
    tall = size[2] > 1.3
    maker = prints.shelf if tall and rng.random() < 0.6 else prints.carton
    panels = []
    for corner, right, down in box_faces(centre, size, yaw):
        shape = (pixels(down, WALL_PIXELS_PER_METRE), pixels(right, WALL_PIXELS_PER_METRE))
        chosen = prints.poster if maker is prints.carton and rng.random() < 0.35 else maker
        panels.append(Panel(corner, right, down, chosen(rng, *shape)))
    return panels


def furniture(rng: np.random.Generator, space: Space, path: NDArray[np.float64], count: int) -> list[Panel]:
    """Return up to ``count`` boxes along the walls of a space, none nearer than CLEARANCE_M to the path (N, 2)."""
    panels: list[Panel] = []
    taken: list[tuple[Vector, float]] = []
    for _ in range(12 * count):
        if len(taken) == count:
            break
        size = np.array([rng.uniform(0.3, 1.1), rng.uniform(0.25, 0.6), rng.uniform(0.4, 2.0)])
        side = int(rng.integers(4))
        left, right = space.sides()[side]
        along = (right - left) / np.linalg.norm(right - left)
        inward = np.array([along[1], -along[0], 0.0])
        place = left + (right - left) * rng.uniform(0.08, 0.92)
        yaw = float(np.arctan2(along[1], along[0]))
        away = size[1] / 2 + 0.03
        if rng.random() < 0.4:  # stands free and askew
            away = rng.uniform(0.5, 1.2)
            yaw += rng.uniform(-0.7, 0.7)
        centre = place + inward * away
        radius = 0.5 * float(np.hypot(size[0], size[1]))
        clear = float(np.min(np.linalg.norm(path - centre[:2], axis=1))) > radius + CLEARANCE_M
        if clear and all(np.linalg.norm(centre - other) > 0.8 * (radius + reach) for other, reach in taken):
            taken.append((centre, radius))
            panels += _box(rng, centre + UP * size[2] / 2, size, yaw)
    return panels
