"""From a floor plan (rectangles that touch) to walls, floors, ceilings, furniture and lamps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import fittings, plain, prints, shading, textures
from seamark.datasets_synth.clutter import UNCHANGED, Change
from seamark.datasets_synth.panels import Panel, Vector, box_faces, pixels
from seamark.datasets_synth.textures import Field, Image
from seamark.datasets_synth.world import Lamp

WALL_PIXELS_PER_METRE = 150.0
GROUND_PIXELS_PER_METRE = 110.0
CLEARANCE_M = 0.75  # between the path and anything that stands on the floor
LIGHT_M = 1.0  # what is lower than that gets moved between runs
WALL_CONTRAST, FLOOR_CONTRAST = (0.4, 0.8), (0.45, 0.8)  # of all others, as worn as they are
SATURATION = 0.6  # of prints and furniture
POLISHED, GLOSS = 0.6, (0.3, 0.9)  # how many floors shine, and how much
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Finish:
    """How spaces are finished: shares of walls painted and of floors covered with linoleum, and the surfaces of others.

    ``gaps_m`` is the least and most between things that hang on walls.
    """

    painted: float = 0.5
    linoleum: float = 0.5
    walls: tuple[textures.Surface, ...] = textures.WALLS
    floors: tuple[textures.Surface, ...] = textures.FLOORS
    gaps_m: tuple[float, float] = (0.3, 1.6)


FINISH = Finish()
Footprint = NDArray[np.float64]  # (4, 2) m in the world, of something that stands on the floor


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

    def holds(self, centre: Vector, radius: float) -> bool:
        """Return whether a circle about ``centre`` is inside the walls."""
        x, y = float(centre[0]), float(centre[1])
        inside = self.west + radius < x < self.east - radius
        return inside and self.south + radius < y < self.north - radius

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


def _side_picture(rng: np.random.Generator, length: float, height: float, colour: Field, finish: Finish) -> Image:
    """Return the surface of a whole side of a space: paint, or another that is worn."""
    shape = (max(8, round(height * WALL_PIXELS_PER_METRE)), max(8, round(length * WALL_PIXELS_PER_METRE)))
    if rng.random() < finish.painted:
        return plain.painted(rng, *shape, WALL_PIXELS_PER_METRE, colour)
    surface = finish.walls[int(rng.integers(len(finish.walls)))]
    image = surface(rng, *shape, WALL_PIXELS_PER_METRE)
    return plain.worn(rng, image, WALL_PIXELS_PER_METRE, WALL_CONTRAST)


def _hang(rng: np.random.Generator, image: Image, finish: Finish) -> Image:
    """Return a wall with a few stickers, and posters, notice boards and radiators with gaps between them."""
    scale = WALL_PIXELS_PER_METRE
    image = prints.add_stickers(rng, image, scale, 0.4)
    height, length = image.shape[0] / scale, image.shape[1] / scale
    reach = rng.uniform(0.2, 1.2)
    while reach < length - 0.7 and height > 1.5:
        kind = rng.random()
        if kind < 0.12:
            size, bottom = (min(1.4, length - reach - 0.1), 0.6), 0.15
        else:
            size = (min(rng.uniform(0.4, 1.2), length - reach - 0.1), rng.uniform(0.4, 1.1))
            bottom = rng.uniform(max(1.5, size[1] + 0.2), height - 0.1) - size[1]
        maker = fittings.radiator if kind < 0.12 else fittings.notice_board if kind < 0.3 else prints.poster
        width_px, height_px = (round(extent * scale) for extent in size)
        row, column = round((height - bottom - size[1]) * scale), round(reach * scale)
        picture = plain.muted(maker(rng, height_px, width_px), SATURATION)
        target = image[row : row + height_px, column : column + width_px]
        target[:] = picture[: target.shape[0], : target.shape[1]]
        reach += size[0] + rng.uniform(*finish.gaps_m)
    return image


def walls(rng: np.random.Generator, space: Space, others: list[Space], finish: Finish = FINISH) -> list[Panel]:
    """Return the walls of a space, leaving out where others touch it, with the piece above a lower opening."""
    panels, colour, scale = [], plain.paint(rng), WALL_PIXELS_PER_METRE
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
        pieces = [piece for piece in pieces if piece[1] - piece[0] > 0.02]
        if not pieces:
            continue
        side = _side_picture(rng, length, space.height, colour, finish)
        for begin, end, bottom in pieces:
            rows = slice(0, max(8, round((space.height - bottom) * scale)))
            first = min(round(begin * scale), side.shape[1] - 8)
            image = side[rows, first : max(first + 8, round(end * scale))]
            image = _hang(rng, image, finish)
            corners = (1.0, float(end > length - 0.01), float(bottom == 0), float(begin < 0.01))
            rows_px, columns_px = image.shape[:2]
            image = shading.shaded(image, shading.edges(rows_px, columns_px, scale, corners))
            corner = left + begin * along + space.height * UP
            panels.append(Panel(corner, (end - begin) * along, -(space.height - bottom) * UP, image))
    return panels


def _ground(rng: np.random.Generator, shape: tuple[int, int], scale: float, finish: Finish) -> Image:
    """Return a floor: linoleum, or a patterned one as worn as it is."""
    if rng.random() < finish.linoleum:
        return plain.linoleum(rng, *shape, scale)
    surface = finish.floors[int(rng.integers(len(finish.floors)))]
    return plain.worn(rng, surface(rng, *shape, scale), scale, FLOOR_CONTRAST)


def floor_and_ceiling(
    rng: np.random.Generator,
    space: Space,
    others: list[Space],
    things: Sequence[Footprint] = (),
    finish: Finish = FINISH,
) -> list[Panel]:
    """Return the floor and the ceiling, darker along the walls and under the ``things`` that stand about."""
    scale = GROUND_PIXELS_PER_METRE
    across, deep = np.array([space.east - space.west, 0, 0]), np.array([0, space.north - space.south, 0])
    shape = (pixels(deep, scale), pixels(across, scale))
    north, east, south, west = (
        shading.along(shape[1 - k % 2], scale, [opening[:2] for opening in _openings(*side, others)])
        for k, side in enumerate(space.sides())
    )
    corners = shading.edges(*shape, scale, (north, east, south[::-1], west[::-1]))
    outlines = [(thing - (space.west, space.north)) * (scale, -scale) for thing in things]
    ground = shading.shaded(_ground(rng, shape, scale, finish), corners, shading.contact(*shape, scale, outlines))
    above = shading.shaded(plain.ceiling(rng, *shape, scale), corners[::-1])
    gloss = float(rng.uniform(*GLOSS)) if rng.random() < POLISHED else 0.0
    floor = Panel(np.array([space.west, space.north, 0.0]), across, -deep, ground, gloss=gloss)
    return [floor, Panel(np.array([space.west, space.south, space.height]), across, deep, above)]


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


def _box_pictures(rng: np.random.Generator, size: Vector) -> list[Image]:
    """Return the pictures of a piece of furniture, faces as of box_faces: a book shelf if tall, else a crate."""
    tall = size[2] > 1.3
    maker = prints.shelf if tall and rng.random() < 0.6 else prints.carton
    images = []
    for _, right, down in box_faces(np.zeros(3), size):
        shape = (pixels(down, WALL_PIXELS_PER_METRE), pixels(right, WALL_PIXELS_PER_METRE))
        chosen = prints.poster if maker is prints.carton and rng.random() < 0.1 else maker
        image = plain.muted(chosen(rng, *shape), SATURATION)
        images.append(shading.shaded(image, shading.edges(*shape, WALL_PIXELS_PER_METRE, (0.0, 0.2, 0.6, 0.2))))
    return images


def _footprint(centre: Vector, size: Vector, yaw: float) -> Footprint:
    c, s = np.cos(yaw), np.sin(yaw)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size[:2] / 2
    return np.asarray(corners @ np.array([[c, s], [-s, c]]) + centre[:2])


def _somewhere(rng: np.random.Generator, space: Space) -> tuple[Vector, Vector, float, tuple[Vector, Vector]]:
    """Return the size of a box, where it may stand (centre and yaw), and the directions along the wall and inward."""
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
    return size, centre, yaw, (along, inward)


def furniture(
    rng: np.random.Generator,
    space: Space,
    path: NDArray[np.float64],
    count: int,
    became: Callable[[int], Change] = lambda _: UNCHANGED,
    occupied: Sequence[tuple[Vector, float]] = (),
) -> tuple[list[Panel], list[Footprint]]:
    """Return up to ``count`` boxes along the walls of a space, none nearer than CLEARANCE_M to the path (N, 2).

    ``occupied`` are circles, (3,) and radius in m, where something stands already. ``became`` says what happened to
    each by number; only light ones are moved, and only where the way stays clear and no wall is touched.
    """
    panels: list[Panel] = []
    prints_on_floor: list[Footprint] = []
    taken = [*occupied]

    def fits(centre: Vector, radius: float) -> bool:
        return float(np.min(np.linalg.norm(path - centre[:2], axis=1))) > radius + CLEARANCE_M

    for _ in range(12 * count):
        if len(taken) == count + len(occupied):
            break
        size, centre, yaw, axes = _somewhere(rng, space)
        radius = 0.5 * float(np.hypot(size[0], size[1]))
        if not fits(centre, radius) or any(
            np.linalg.norm(centre - other) < 0.8 * (radius + reach) for other, reach in taken
        ):
            continue
        change = became(len(taken)) if size[2] < LIGHT_M else UNCHANGED
        taken.append((centre, radius))
        images = _box_pictures(rng, size)
        moved_to = centre + change.along_m * axes[0] + abs(change.across_m) * axes[1]
        if not change.present:
            continue
        if fits(moved_to, radius) and space.holds(moved_to, radius):
            centre, yaw = moved_to, yaw + change.turn_rad
        faces = box_faces(centre + UP * size[2] / 2, size, yaw)
        panels += [Panel(*face, image) for face, image in zip(faces, images, strict=True)]
        prints_on_floor.append(_footprint(centre, size, yaw))
    return panels, prints_on_floor
