"""The world ``street``: once round a block of houses, with houses across the street, cars, trees and lamps."""

from collections.abc import Callable
from functools import partial

import numpy as np

from seamark.datasets_synth import avenue
from seamark.datasets_synth.avenue import Stock, asphalt, pavement, strips
from seamark.datasets_synth.clutter import Change, change
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.world import Lamp, Sun, World

BLOCK = (19.0, 10.0)  # half the sides of the block
STREET_M = 13.0  # from front to front
PAVEMENT_M = 2.2
LANE_M = 4.8  # of the camera from the fronts of the block
EYE_M = 1.6
HOUSE_M = (7.0, 12.0)
HEIGHT_M = (7.0, 13.0)
HOUSE_DEPTH_M = 8.0
LAMP_SPACING_M = 16.0
KERB_M = 0.12


def street_route(_: str) -> Route:
    """Return the lane round the block, anticlockwise."""
    x, y = BLOCK[0] + LANE_M, BLOCK[1] + LANE_M
    waypoints = np.array([[-x, -y, EYE_M], [x, -y, EYE_M], [x, y, EYE_M], [-x, y, EYE_M]])
    return Route("block", waypoints, True, 4.0, 4.0, 1.2)


def _sides(half_x: float, half_y: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the sides of a rectangle as (from, to), anticlockwise from the south."""
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    return [(corners[k], corners[(k + 1) % 4]) for k in range(4)]


def _row(rng: np.random.Generator, things: Stock, a: np.ndarray, b: np.ndarray, *, inward: bool) -> list[Panel]:
    """Return houses wall to wall from a to b (2,), whose fronts look to the right of the way, or to the left."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    out = np.array([along[1], -along[0]]) * (-1 if inward else 1)
    facing = float(np.arctan2(out[1], out[0]))
    panels, reach = [], 0.05  # so that its end is not in the plane of the next row
    length -= 0.05
    while reach < length - 0.1:
        width = float(rng.uniform(*HOUSE_M))
        if length - reach - width < HOUSE_M[0]:
            width = length - reach
        front = np.array([*(a + along * (reach + width / 2)), 0.0])
        panels += avenue.house(rng, things, front, facing, (HOUSE_DEPTH_M, width, float(rng.uniform(*HEIGHT_M))))
        reach += width
    return panels


def _furnish(
    rng: np.random.Generator, things: Stock, a: np.ndarray, b: np.ndarray, became: Callable[[int], Change]
) -> tuple[list[Panel], list[Lamp]]:
    """Return lamps, trees, signs and parked cars along a side a-b (2,) of the block, on both pavements.

    ``became`` says which cars have left or have parked again elsewhere.
    """
    aside = STREET_M
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    out = np.array([along[1], -along[0]])
    yaw = float(np.arctan2(along[1], along[0]))
    panels: list[Panel] = []
    lamps = []

    def at(s: float, d: float) -> np.ndarray:
        return np.array([*(a + s * along + d * out), 0.0])

    for number, s in enumerate(np.arange(LAMP_SPACING_M / 2, length, LAMP_SPACING_M)):
        near = number % 2 == 0
        towards = np.array([*out, 0.0]) * (1 if near else -1)
        more, lamp = avenue.street_lamp(things, at(float(s), 1.7 if near else aside - 1.7), towards)
        panels += more
        lamps.append(lamp)
    for s in np.arange(3.0, length - 2, 5.0):
        kind = int(rng.integers(4))
        d = float(rng.choice([1.2, aside - 1.2]))
        if kind < 3:
            panels += avenue.tree(rng, things, at(float(s) + rng.uniform(-1, 1), d))
        else:
            panels += avenue.sign(rng, things, at(float(s), d), yaw + np.pi)
    for number, s in enumerate(np.arange(4.0, length - 4, 5.5)):
        for kind, (share, d) in enumerate(((0.75, aside - PAVEMENT_M - 1.0), (0.25, PAVEMENT_M + 0.2))):
            if rng.random() < share:
                now = became(2 * number + kind)
                parked = at(float(s) + float(np.clip(now.along_m, -0.4, 0.4)), d)
                vehicle = avenue.car(rng, things, parked, yaw + rng.normal(0, 0.03) + 0.05 * now.turn_rad)
                panels += vehicle if now.present else []
    return panels, lamps


def build_street(_: str, seed: int, run: int = 0) -> World:
    """Return the world; with ``run`` change leaves, clouds and some parked cars."""
    rng = np.random.default_rng([seed, 0x57EE])
    weather = np.random.default_rng([seed, run, 0x57EF])
    things = avenue.stock(rng, weather)
    road = [asphalt(rng, avenue.STRIP_M, STREET_M - 2 * PAVEMENT_M, lane=True) for _ in range(4)]
    slabs = [pavement(rng) for _ in range(3)]
    ground = asphalt(rng, 16.0, 16.0, lane=False)
    whole = np.array([BLOCK[0] + STREET_M + 1, BLOCK[1] + STREET_M + 1])
    corner = np.array([-whole[0], whole[1], -0.02])
    panels = [
        Panel(corner, np.array([2 * whole[0], 0, 0]), np.array([0, -2 * whole[1], 0]), ground, tiles=(4.0, 3.0)),
        *avenue.sky(rng, weather, (0.0, 0.0)),
    ]
    lamps: list[Lamp] = []
    for number, (a, b) in enumerate(_sides(*BLOCK)):
        panels += _row(rng, things, a, b, inward=False)
        more, lights = _furnish(rng, things, a, b, partial(change, seed, run, number))
        panels += more
        lamps += lights
        points = a + np.linspace(0, 1, 1 + round(float(np.linalg.norm(b - a)) / avenue.STRIP_M))[:, None] * (b - a)
        panels += strips(points, (PAVEMENT_M - STREET_M, -PAVEMENT_M), 0.0, road)
        panels += strips(points, (-PAVEMENT_M, 0.0), KERB_M, slabs)
        panels += strips(points, (-STREET_M, PAVEMENT_M - STREET_M), KERB_M, slabs)
    for a, b in _sides(BLOCK[0] + STREET_M, BLOCK[1] + STREET_M):
        panels += _row(rng, things, a, b, inward=True)
    sun = Sun(np.array([0.45, 0.3, -0.8]), (1.1, 1.05, 0.95))
    return World(tuple(panels), tuple(lamps), (0.5, 0.52, 0.56), sun, lamps_at_once=6, far_m=700.0)
