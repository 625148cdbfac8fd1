"""The world ``office``: a corridor between two rows of rooms that have the same walls, furniture and windows.

One room and one piece of the corridor are made and then repeated with the same pictures; two posters, a carton and
the sign at the door tell rooms apart. Doors lead from room to room and to the corridor.
"""

import cv2
import numpy as np

from seamark.datasets_synth import floor_plan, outdoors, prints, textures
from seamark.datasets_synth.floor_plan import Space
from seamark.datasets_synth.panels import Panel, Vector, box_faces, moved
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.textures import Image
from seamark.datasets_synth.world import Lamp, World

ROOMS = 3  # on either side
PITCH_M = 5.2
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
    return Route("rooms", waypoints, True, 0.7, 1.5, 0.45)


def _window(rng: np.random.Generator) -> Image:
    """Return the view out of a window, with its frame."""
    image = outdoors.facade(rng, 520, 480)[130:390].copy()
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
    panels = floor_plan.walls(rng, room, [front, east, west]) + floor_plan.floor_and_ceiling(rng, room)
    beyond = [Space(-9, 9, -9, -THICKNESS_M, 9), Space(half + BETWEEN_M, 9, -9, 9, 9)]
    for door, far in ((front, beyond[0]), (east, beyond[1])):
        panels += floor_plan.walls(rng, door, [room, far]) + floor_plan.floor_and_ceiling(rng, door)
    s = np.linspace(-half, half, 100)
    path = np.vstack([np.column_stack([s, np.full(100, INNER_DOOR_Y_M)]), [[DOOR_X_M, 0.03 * k] for k in range(100)]])
    panels += floor_plan.furniture(rng, room, path, FURNITURE)
    panels += _desk(rng, np.array([-half + 0.95, 0.75, 0.0]))
    glass = Panel(
        np.array([-1.3, DEPTH_M - 0.01, 2.3]), np.array([2.4, 0, 0]), np.array([0, 0, -1.3]), _window(rng), 0.9, True
    )
    return [*panels, glass, _lamp_panel(0.0, DEPTH_M / 2)]


def _desk(rng: np.random.Generator, foot: Vector) -> list[Panel]:
    """Return a desk with a screen and a box on it."""
    parts = [(np.array([0, 0, 0.36]), np.array([1.5, 0.75, 0.72])), (np.array([-0.2, -0.1, 0.95]), (0.6, 0.06, 0.4))]
    parts.append((np.array([0.5, 0.1, 0.82]), (0.25, 0.3, 0.2)))
    panels = []
    for centre, size in parts:
        for corner, right, down in box_faces(foot + centre, np.array(size)):
            shape = [max(12, int(np.linalg.norm(edge) * PIXELS_PER_METRE)) for edge in (down, right)]
            panels.append(Panel(corner, right, down, prints.carton(rng, *shape)))
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
    panels = floor_plan.walls(rng, piece, [*doors, *ends]) + floor_plan.floor_and_ceiling(rng, piece)
    return [*panels, _lamp_panel(0, 0)]


def _poster(rng: np.random.Generator, corner: tuple[float, float, float], right: Vector, height: float) -> Panel:
    width = float(np.linalg.norm(right))
    shape = (int(height * PIXELS_PER_METRE), int(width * PIXELS_PER_METRE))
    return Panel(np.array(corner), right, np.array([0, 0, -height]), prints.poster(rng, *shape))


def _own(rng: np.random.Generator, closed_west: bool, closed_east: bool) -> list[Panel]:
    """Return what a room has for itself: posters, a carton, the sign at its door, and leaves where doors are shut."""
    half = (PITCH_M - BETWEEN_M) / 2
    panels = [_poster(rng, (-half + 0.012, 0.5 + rng.uniform(0, 0.6), 2.2), np.array([0, 0.8, 0]), 0.9)]
    panels.append(_poster(rng, (half - 0.012, 1.9 - rng.uniform(0, 0.6), 2.3), np.array([0, -0.9, 0]), 0.8))
    sign = (DOOR_X_M - DOOR_M / 2 - 0.15, -THICKNESS_M - 0.012, 1.7)
    panels.append(_poster(rng, sign, np.array([-0.35, 0, 0]), 0.25))
    size = rng.uniform((0.3, 0.3, 0.3), (0.5, 0.5, 0.6))
    centre = np.array([rng.uniform(-0.3, 0.1), 0.4, size[2] / 2])
    for corner, right, down in box_faces(centre, size, rng.uniform(-0.5, 0.5)):
        panels.append(Panel(corner, right, down, prints.carton(rng, 80, 80)))
    low, high = INNER_DOOR_Y_M - DOOR_M / 2, INNER_DOOR_Y_M + DOOR_M / 2
    if closed_west:
        panels.append(_poster(rng, (-half, low, DOOR_HEIGHT_M), np.array([0, high - low, 0]), DOOR_HEIGHT_M))
    if closed_east:
        panels.append(_poster(rng, (half, high, DOOR_HEIGHT_M), np.array([0, low - high, 0]), DOOR_HEIGHT_M))
    return panels


def build_office(_: str, seed: int) -> World:
    """Return the world."""
    rng = np.random.default_rng([seed, 0x0FF1])
    room, piece = _room(rng), _corridor(rng)
    panels: list[Panel] = []
    lamps: list[Lamp] = []
    front = HALF_CORRIDOR_M + THICKNESS_M
    for number, x in enumerate(_middles()):
        panels += [moved(panel, 0.0, np.array([x, 0, 0])) for panel in piece]
        lamps.append(Lamp(np.array([x, 0, HEIGHT_M - 0.7]), LAMP))
        for side, yaw in ((1, 0.0), (-1, np.pi)):
            own = np.random.default_rng([seed, number, side + 1, 0x0FF2])
            shut = (number == 0, number == ROOMS - 1)
            things = [*room, *_own(own, *(shut if side == 1 else shut[::-1]))]
            panels += [moved(panel, yaw, np.array([x, side * front, 0])) for panel in things]
            lamps.append(Lamp(np.array([x, side * (front + DEPTH_M / 2), HEIGHT_M - 0.7]), LAMP))
    for sign in (1, -1):  # the ends of the corridor
        end = sign * ROOMS * PITCH_M / 2
        right = np.array([0, -sign * 2 * HALF_CORRIDOR_M, 0])
        shape = (int(HEIGHT_M * PIXELS_PER_METRE), int(2 * HALF_CORRIDOR_M * PIXELS_PER_METRE))
        image = prints.add_stickers(rng, textures.plaster(rng, *shape, PIXELS_PER_METRE), PIXELS_PER_METRE, 4.0)
        panels.append(
            Panel(np.array([end, sign * HALF_CORRIDOR_M, HEIGHT_M]), right, np.array([0, 0, -HEIGHT_M]), image)
        )
        shift = np.array([-0.012 * sign, -0.6 * sign, 0])
        panels.append(_poster(rng, tuple(panels[-1].corner + shift - (0, 0, 0.5)), 0.4 * right, 1.2))
    return World(tuple(panels), tuple(lamps), (0.5, 0.5, 0.52), lamps_at_once=8)
