"""The world ``road``: a country road that never comes back, with bends, trees, posts, signs and a few houses."""

import numpy as np

from seamark.datasets_synth import avenue, outdoors, plain
from seamark.datasets_synth.avenue import Stock, asphalt, strips
from seamark.datasets_synth.panels import Panel, Vector, box_faces
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.textures import to_image
from seamark.datasets_synth.world import Lamp, Sun, World

STEP_M = 12.0
TURNS_DEG = (0,) * 8 + (9,) * 8 + (0,) * 5 + (-8,) * 10 + (0,) * 5 + (5, -5) * 3  # from one step to the next
ROAD_M = 7.0
LANE_M = -1.7  # of the camera, to the left of the middle
EYE_M = 1.6
VERGE_M = 30.0
LAMP_SPACING_M = 30.0


def middle() -> np.ndarray:
    """Return the middle of the road (N, 2)."""
    headings = np.deg2rad(np.cumsum(TURNS_DEG))
    steps = STEP_M * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    return np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _beside(points: np.ndarray, aside: float) -> np.ndarray:
    """Return the polyline (N, 2) moved to its left."""
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return points + aside * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def road_route(_: str) -> Route:
    """Return the right lane, ending some way before the road does."""
    lane = _beside(middle(), LANE_M)[:-4]
    return Route("lane", np.column_stack([lane, np.full(len(lane), EYE_M)]), False, 15.0, 9.0, 1.5)


def _along(points: np.ndarray, s: float, aside: float) -> tuple[Vector, float]:
    """Return the place (3,) on the ground after ``s`` m of the road and beside it, and the yaw of the road there."""
    number = int(np.clip(s / STEP_M, 0, len(points) - 2))
    step = (points[number + 1] - points[number]) / STEP_M
    place = points[number] + (s - number * STEP_M) * step + aside * np.array([-step[1], step[0]])
    return np.array([*place, 0.0]), float(np.arctan2(step[1], step[0]))


def _clear(points: np.ndarray, place: Vector, distance: float) -> bool:
    return float(np.linalg.norm(points - place[:2], axis=1).min()) > distance


def _post(things: Stock, foot: Vector) -> list[Panel]:
    """Return a white post at the edge of the road."""
    faces = box_faces(foot + np.array([0, 0, 0.5]), np.array([0.12, 0.12, 1.0]))
    return [Panel(*face, things.white) for face in faces]


def _roadside(rng: np.random.Generator, things: Stock, points: np.ndarray) -> tuple[list[Panel], list[Lamp]]:
    """Return all that stands beside the road."""
    panels: list[Panel] = []
    lamps: list[Lamp] = []
    length, half = STEP_M * (len(points) - 1), ROAD_M / 2
    fine = np.concatenate([points[:-1] + share * (points[1:] - points[:-1]) for share in (0, 0.33, 0.67)])
    for side in (1.0, -1.0):
        for s in np.arange(6.0, length, 11.0):
            foot, yaw = _along(points, float(s), side * (half + 0.8))
            panels += _post(things, foot)
        for s in np.arange(4.0, length, 5.0):
            place, yaw = _along(points, float(s + rng.uniform(-2, 2)), side * (half + float(rng.uniform(2.5, 11))))
            kind = rng.random()
            if not _clear(fine, place, half + 2.2):
                continue
            if kind < 0.55:
                panels += avenue.tree(rng, things, place)
            elif kind < 0.7:
                panels += avenue.sign(rng, things, place, yaw + np.pi + rng.normal(0, 0.2))
            elif kind < 0.8:
                panels += avenue.car(rng, things, place, yaw + rng.normal(0, 0.6), on_asphalt=False)
        for s in np.arange(15.0, length, 24.0) + 12 * (side > 0):
            size = (float(rng.uniform(6, 9)), float(rng.uniform(7, 12)), float(rng.uniform(4, 9)))
            front, yaw = _along(points, float(s), side * (half + float(rng.uniform(7, 12))))
            back = front + 8 * np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * side
            if rng.random() < 0.75 and _clear(fine, front, half + 5) and _clear(fine, back, half + 8):
                panels += avenue.house(rng, things, front, yaw - side * np.pi / 2 + rng.normal(0, 0.15), size)
    for number, s in enumerate(np.arange(10.0, length, LAMP_SPACING_M)):
        side = 1.0 if number % 2 else -1.0
        foot, yaw = _along(points, float(s), side * (half + 1.0))
        more, lamp = avenue.street_lamp(things, foot, side * np.array([np.sin(yaw), -np.cos(yaw), 0.0]))
        panels += more
        lamps.append(lamp)
    return panels, lamps


def build_road(_: str, seed: int, run: int = 0) -> World:
    """Return the world; with ``run`` change leaves and clouds."""
    rng = np.random.default_rng([seed, 0x20AD])
    weather = np.random.default_rng([seed, run, 0x20AE])
    things, points = avenue.stock(rng, weather), middle()
    surfaces = [asphalt(rng, avenue.STRIP_M, ROAD_M, lane=True) for _ in range(7)]
    low, high = points.min(axis=0) - 120, points.max(axis=0) + 120
    meadow = to_image(plain.muted(outdoors.grass(rng, 1024, 1024), 0.5) * np.array([0.5, 0.85, 0.75]))
    size = high - low
    ground = Panel(
        np.array([low[0], high[1], -0.05]),
        np.array([size[0], 0, 0]),
        np.array([0, -size[1], 0]),
        meadow,
        tiles=(size[0] / 9, size[1] / 9),
    )
    centre = (low + high) / 2
    panels = [ground, *avenue.sky(rng, weather, (float(centre[0]), float(centre[1])))]
    panels += strips(points, (-ROAD_M / 2, ROAD_M / 2), 0.0, surfaces)
    more, lamps = _roadside(rng, things, points)
    sun = Sun(np.array([0.3, 0.5, -0.8]), (1.1, 1.05, 0.95))
    return World(tuple(panels + more), tuple(lamps), (0.5, 0.52, 0.56), sun, lamps_at_once=6, far_m=900.0)
