"""The world ``office``: a corridor between two rows of rooms that have the same walls, furniture and windows.

One room and one piece of the corridor are made and then repeated with the same pictures; a small poster, a carton and
the number at the door tell rooms apart. Doors lead from room to room and to the corridor.
"""

import cv2
import numpy as np

from seamark.datasets_synth import fittings, floor_plan, plain, prints, shading, textures
from seamark.datasets_synth.clutter import change
from seamark.datasets_synth.floor_plan import Space
from seamark.datasets_synth.panels import Panel, Vector, box_faces, moved, pixels
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.textures import Image
from seamark.datasets_synth.world import Lamp, World

ROOMS = 3  # on either side
PITCH_M = 4.8
DEPTH_M = 4.2
BETWEEN_M = 0.2  # thickness of the walls between rooms
HALF_CORRIDOR_M = 1.2
THICKNESS_M = 0.15  # of the walls of the corridor
HEIGHT_M = 2.6
DOOR_HEIGHT_M = 2.1
DOOR_M = 1.1
DOOR_X_M = 1.3  # of the door to the corridor, from the middle of a room
INNER_DOOR_Y_M = 2.9  # of the doors from room to room, from the front of a room
EYE_M = 1.3
FURNITURE = 5
PIXELS_PER_METRE = 150.0
FINISH = floor_plan.Finish(
    0.35, 0.0, (textures.brick, textures.wood, textures.plaster), (textures.wood, textures.carpet), (0.05, 0.35)
)
LAMP = (1.7, 1.6, 1.45)


def _middles() -> list[float]:
    """Return x of the middle of every room."""
    return [(number - (ROOMS - 1) / 2) * PITCH_M for number in range(ROOMS)]


def office_route(_: str) -> Route:
    """Return the way along the corridor and back through the rooms of one side, then again through the other side."""
    first, last = _middles()[0], _middles()[-1]
    y = HALF_CORRIDOR_M + THICKNESS_M + INNER_DOOR_Y_M
    corners = [(first - DOOR_X_M, 0), (last + DOOR_X_M, 0), (last + DOOR_X_M, y), (first + DOOR_X_M, y)]
    corners += [(first + DOOR_X_M, 0), (last - DOOR_X_M, 0), (last - DOOR_X_M, -y), (first - DOOR_X_M, -y)]
    waypoints = np.column_stack([np.array(corners, np.float64), np.full(len(corners), EYE_M)])
    return Route("rooms", waypoints, True, 0.8, 2.0, 0.45)


def _window(rng: np.random.Generator) -> Image:
    """Return the view out of a window, with its frame."""
    image = cv2.GaussianBlur(fittings.front(rng, 520, 480, 45.0)[130:390], (0, 0), 1.0)
    image = textures.to_image(0.6 * image + 85.0)
    cv2.rectangle(image, (0, 0), (479, 259), (60, 62, 66), 16)
    cv2.line(image, (240, 0), (240, 259), (60, 62, 66), 12)
    return image


def _room(rng: np.random.Generator) -> list[Panel]:
    """Return the room that all are copies of: x about its middle, y from its front; with two of its doors."""
    half = (PITCH_M - BETWEEN_M) / 2
    room = Space(-half, half, 0, DEPTH_M, HEIGHT_M)
    low, high = INNER_DOOR_Y_M - DOOR_M / 2, INNER_DOOR_Y_M + DOOR_M / 2
    front = Space(DOOR_X_M - DOOR_M / 2, DOOR_X_M + DOOR_M / 2, -THICKNESS_M, 0, DOOR_HEIGHT_M)
    east = Space(half, half + BETWEEN_M, low, high, DOOR_HEIGHT_M)
    west = Space(-half - BETWEEN_M, -half, low, high, DOOR_HEIGHT_M)
    doors = [front, east, west]
    beyond = [Space(-9, 9, -9, -THICKNESS_M, 9), Space(half + BETWEEN_M, 9, -9, 9, 9)]
    panels = floor_plan.walls(rng, room, doors, FINISH)
    for door, far in ((front, beyond[0]), (east, beyond[1])):
        panels += floor_plan.walls(rng, door, [room, far])
        panels += floor_plan.floor_and_ceiling(rng, door, [room, far])
    s = np.linspace(-half, half, 100)
    path = np.vstack([np.column_stack([s, np.full(100, INNER_DOOR_Y_M)]), [[DOOR_X_M, 0.03 * k] for k in range(100)]])
    occupied = [(np.array([-half + 0.95, 0.75, 0.0]), 0.85), (np.array([-half + 1.0, 1.5, 0.0]), 0.6)]
    occupied.append((np.array([-0.1, DEPTH_M, 0.0]), 1.0))  # nothing stands before the window
    boxes, footprints = floor_plan.furniture(rng, room, path, FURNITURE, occupied=occupied)
    desk, under = _desk(rng, occupied[0][0])
    panels += [*boxes, *desk, *floor_plan.floor_and_ceiling(rng, room, doors, [*footprints, under], FINISH)]
    corner = np.array([-1.3, DEPTH_M - 0.01, 2.3])
    glass = Panel(corner, np.array([2.4, 0, 0]), np.array([0, 0, -1.3]), _window(rng), 0.9, True)
    image = fittings.whiteboard(rng, int(0.9 * PIXELS_PER_METRE), int(1.4 * PIXELS_PER_METRE))
    board = Panel(np.array([0.2, 0.012, 1.95]), np.array([-1.4, 0, 0]), np.array([0, 0, -0.9]), image, gloss=0.9)
    return [*panels, glass, board, _lamp_panel(0.0, DEPTH_M / 2)]


def _printed_box(rng: np.random.Generator, centre: Vector, size: Vector, yaw: float = 0.0) -> list[Panel]:
    panels = []
    for corner, right, down in box_faces(centre, size, yaw):
        shape = [max(12, int(np.linalg.norm(edge) * PIXELS_PER_METRE)) for edge in (down, right)]
        panels.append(Panel(corner, right, down, plain.muted(prints.carton(rng, *shape), floor_plan.SATURATION)))
    return panels


def _desk(rng: np.random.Generator, foot: Vector) -> tuple[list[Panel], floor_plan.Footprint]:
    """Return a desk with a screen and a box on it, and where it stands."""
    size = np.array([1.5, 0.75, 0.72])
    panels = []
    for corner, right, down in box_faces(foot + np.array([0, 0, 0.36]), size):
        shape = (pixels(down, PIXELS_PER_METRE), pixels(right, PIXELS_PER_METRE))
        board = plain.muted(textures.wood(rng, *shape, PIXELS_PER_METRE), 0.5)
        panels.append(Panel(corner, right, down, plain.worn(rng, board, PIXELS_PER_METRE, (0.4, 0.5)), gloss=0.5))
    for centre, part in (((-0.2, -0.1, 0.95), (0.6, 0.06, 0.4)), ((0.5, 0.1, 0.82), (0.25, 0.3, 0.2))):
        panels += _printed_box(rng, foot + np.array(centre), np.array(part))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size[:2] / 2
    return panels, corners + foot[:2]


def _chair(rng: np.random.Generator) -> list[Panel]:
    """Return a chair about the origin that looks along y: a seat on a post, and a back."""
    panels = []
    for centre, size in (
        ((0, 0, 0.45), (0.46, 0.46, 0.09)),
        ((0, 0, 0.2), (0.07, 0.07, 0.4)),
        ((0, -0.22, 0.78), (0.42, 0.06, 0.5)),
    ):
        for corner, right, down in box_faces(np.array(centre, np.float64), np.array(size)):
            shape = (pixels(down, PIXELS_PER_METRE), pixels(right, PIXELS_PER_METRE))
            colour = np.array([70.0, 62.0, 58.0])
            cloth = textures.to_image(textures.tint(colour, 0.1 * textures.noise(rng, *shape, 5.0, 2)))
            panels.append(Panel(corner, right, down, cloth))
    return panels


def _lamp_panel(x: float, y: float) -> Panel:
    white = np.full((8, 8, 3), 235, np.uint8)
    corner = np.array([x - 0.5, y - 0.15, HEIGHT_M - 0.02])
    return Panel(corner, np.array([1.0, 0, 0]), np.array([0, 0.3, 0]), white, glow=1.0)


def _corridor(rng: np.random.Generator) -> list[Panel]:
    """Return one piece of the corridor, as long as a room and open at both ends, doors on both sides."""
    piece = Space(-PITCH_M / 2, PITCH_M / 2, -HALF_CORRIDOR_M, HALF_CORRIDOR_M, HEIGHT_M)
    half = DOOR_M / 2
    doors = [Space(DOOR_X_M - half, DOOR_X_M + half, HALF_CORRIDOR_M, 9, DOOR_HEIGHT_M)]
    doors.append(Space(-DOOR_X_M - half, -DOOR_X_M + half, -9, -HALF_CORRIDOR_M, DOOR_HEIGHT_M))
    ends = [Space(-9, -PITCH_M / 2, -9, 9, 9), Space(PITCH_M / 2, 9, -9, 9, 9)]
    panels = floor_plan.walls(rng, piece, [*doors, *ends], FINISH)
    return [*panels, *floor_plan.floor_and_ceiling(rng, piece, [*doors, *ends], (), FINISH), _lamp_panel(0, 0)]


def _poster(rng: np.random.Generator, corner: tuple[float, float, float], right: Vector, height: float) -> Panel:
    width = float(np.linalg.norm(right))
    shape = (int(height * PIXELS_PER_METRE), int(width * PIXELS_PER_METRE))
    image = plain.muted(prints.poster(rng, *shape), floor_plan.SATURATION)
    return Panel(np.array(corner), right, np.array([0, 0, -height]), image)


def _own(rng: np.random.Generator, chair: list[Panel], seed: int, run: int, number: int) -> list[Panel]:
    """Return what a room has for itself: a poster, a carton, the number at its door, and where its chair stands."""
    half = (PITCH_M - BETWEEN_M) / 2
    panels = [_poster(rng, (half - 0.012, 1.9 - rng.uniform(0, 0.6), 1.9), np.array([0, -0.45, 0]), 0.55)]
    sign = (DOOR_X_M - DOOR_M / 2 - 0.15, -THICKNESS_M - 0.012, 1.7)
    panels.append(Panel(np.array(sign), np.array([-0.22, 0, 0]), np.array([0, 0, -0.14]), _number(100 + number)))
    size = rng.uniform((0.3, 0.3, 0.3), (0.45, 0.45, 0.45))
    place, yaw = np.array([rng.uniform(-0.3, 0.1), 0.4, size[2] / 2]), rng.uniform(-0.5, 0.5)
    carton, became = _printed_box(rng, place, size, yaw), change(seed, run, number, 0)
    if became.present:
        panels += [moved(panel, 0.0, np.array([_short(became.along_m), 0, 0])) for panel in carton]
    became = change(seed, run, number, 1)
    if became.present:
        foot = np.array([-half + 1.0 + _short(became.along_m), 1.5 + _short(became.across_m), 0])
        panels += [moved(panel, np.pi + became.turn_rad, foot) for panel in chair]
    return panels


def _short(shift_m: float) -> float:
    """Return a shift that keeps a thing out of the way."""
    return float(np.clip(shift_m, -0.35, 0.35))


def _number(number: int) -> Image:
    """Return the number of a room, as it stands beside the door."""
    sign = np.full((84, 132, 3), 215, np.uint8)
    cv2.rectangle(sign, (0, 0), (131, 83), (110, 105, 100), 3)
    cv2.putText(sign, str(number), (14, 62), cv2.FONT_HERSHEY_DUPLEX, 1.7, (50, 45, 40), 3, cv2.LINE_AA)
    return sign


def _shut(leaf: Image, east: bool) -> Panel:
    """Return the leaf of a door to the next room that is shut, because there is no next room."""
    half, sign = (PITCH_M - BETWEEN_M) / 2, 1 if east else -1
    corner = np.array([sign * half, INNER_DOOR_Y_M + sign * DOOR_M / 2, DOOR_HEIGHT_M])
    return Panel(corner, np.array([0, -sign * DOOR_M, 0]), np.array([0, 0, -DOOR_HEIGHT_M]), leaf, gloss=0.4)


def build_office(_: str, seed: int, run: int = 0) -> World:
    """Return the world; ``run`` moves cartons and chairs."""
    rng = np.random.default_rng([seed, 0x0FF1])
    room, piece, chair = _room(rng), _corridor(rng), _chair(rng)
    leaf = fittings.door_leaf(rng, int(DOOR_HEIGHT_M * PIXELS_PER_METRE), int(DOOR_M * PIXELS_PER_METRE))
    panels: list[Panel] = []
    lamps: list[Lamp] = []
    front = HALF_CORRIDOR_M + THICKNESS_M
    for column, x in enumerate(_middles()):
        panels += [moved(panel, 0.0, np.array([x, 0, 0])) for panel in piece]
        lamps.append(Lamp(np.array([x, 0, HEIGHT_M - 0.7]), LAMP))
        for side, yaw in ((1, 0.0), (-1, np.pi)):
            number = 2 * column + (side < 0)
            own = np.random.default_rng([seed, number, 0x0FF2])
            things = [*room, *_own(own, chair, seed, run, number)]
            if column in (0, ROOMS - 1):
                things.append(_shut(leaf, (column > 0) == (side > 0)))
            panels += [moved(panel, yaw, np.array([x, side * front, 0])) for panel in things]
            lamps.append(Lamp(np.array([x, side * (front + DEPTH_M / 2), HEIGHT_M - 0.7]), LAMP))
    for sign in (1, -1):  # the ends of the corridor
        end = sign * ROOMS * PITCH_M / 2
        right = np.array([0, -sign * 2 * HALF_CORRIDOR_M, 0])
        shape = (int(HEIGHT_M * PIXELS_PER_METRE), int(2 * HALF_CORRIDOR_M * PIXELS_PER_METRE))
        image = plain.painted(rng, *shape, PIXELS_PER_METRE, plain.paint(rng))
        image = shading.shaded(image, shading.edges(*shape, PIXELS_PER_METRE, (1.0, 1.0, 1.0, 1.0)))
        panels.append(
            Panel(np.array([end, sign * HALF_CORRIDOR_M, HEIGHT_M]), right, np.array([0, 0, -HEIGHT_M]), image)
        )
        shift = np.array([-0.012 * sign, -0.6 * sign, 0])
        panels.append(_poster(rng, tuple(panels[-1].corner + shift - (0, 0, 0.5)), 0.3 * right, 0.9))
    return World(tuple(panels), tuple(lamps), (0.5, 0.5, 0.52), lamps_at_once=8)
