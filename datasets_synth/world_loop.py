"""The world ``loop``: four rooms at the corners of a ring of four corridors, and one lap through them."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import floor_plan
from seamark.datasets_synth.clutter import change
from seamark.datasets_synth.floor_plan import Space
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.walk import STEP_M, rounded, walk
from seamark.datasets_synth.world import World

EYE_HEIGHT_M = 1.3


@dataclass(frozen=True)
class LoopPlan:
    """The measures of a lap: half the distances of the room centres, sizes of rooms and corridors, how it is walked.

    ``rounding_m`` is the sigma of the Gaussian that rounds the corners; ``turn_cost_m`` says how many metres of walking
    one radian of turning costs, so that turns are slow; ``start_m`` and ``overlap_m`` are along the lap.
    """

    half_x: float
    half_y: float
    room_sizes: tuple[tuple[float, float], ...]
    corridor_widths: tuple[float, ...]
    heights: tuple[float, float]
    rounding_m: float
    turn_cost_m: float
    start_m: float
    overlap_m: float
    boxes_per_room: int


FULL = LoopPlan(
    half_x=10.5,
    half_y=6.2,
    room_sizes=((6.4, 5.6), (5.6, 6.6), (7.0, 5.6), (6.0, 6.2)),
    corridor_widths=(2.6, 2.3, 3.4, 2.5),
    heights=(2.9, 2.4),
    rounding_m=1.5,
    turn_cost_m=2.0,
    start_m=2.3,
    overlap_m=4.0,
    boxes_per_room=7,
)
SMALL = LoopPlan(
    half_x=3.1,
    half_y=2.3,
    room_sizes=((3.6, 3.2), (3.4, 3.4), (3.8, 3.2), (3.4, 3.2)),
    corridor_widths=(2.0, 1.9, 2.2, 1.9),
    heights=(2.6, 2.3),
    rounding_m=0.8,
    turn_cost_m=2.6,
    start_m=1.0,
    overlap_m=2.2,
    boxes_per_room=3,
)
PLANS = {"full": FULL, "small": SMALL}


def spaces(plan: LoopPlan) -> list[Space]:
    """Return the four rooms, then the four corridors, anticlockwise from the south-west."""
    corners = [(-plan.half_x, -plan.half_y), (plan.half_x, -plan.half_y), (plan.half_x, plan.half_y)]
    corners.append((-plan.half_x, plan.half_y))
    rooms = [
        Space.about(*corner, *size, plan.heights[0]) for corner, size in zip(corners, plan.room_sizes, strict=True)
    ]
    south_west, south_east, north_east, north_west = rooms
    half = [width / 2 for width in plan.corridor_widths]
    y, x = plan.half_y, plan.half_x
    corridors = [
        Space(south_west.east, south_east.west, -y - half[0], -y + half[0], plan.heights[1]),
        Space(x - half[1], x + half[1], south_east.north, north_east.south, plan.heights[1]),
        Space(north_west.east, north_east.west, y - half[2], y + half[2], plan.heights[1]),
        Space(-x - half[3], -x + half[3], south_west.north, north_west.south, plan.heights[1]),
    ]
    return rooms + corridors


def lap(plan: LoopPlan) -> NDArray[np.float64]:
    """Return one closed lap (N, 2) in steps of at most STEP_M, anticlockwise, corners rounded."""
    x, y = plan.half_x, plan.half_y
    return rounded(np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]]), plan.rounding_m)


def loop_poses(plan: LoopPlan, n_frames: int, seed: int) -> NDArray[np.float64]:
    """Return T_world_cam (N, 4, 4): a lap and ``overlap_m`` more, slow in turns, with the sway of a walking robot."""
    once = lap(plan)
    first, more = (int(length / STEP_M) for length in (plan.start_m, plan.overlap_m))
    path = np.roll(once, -first, axis=0)
    path = np.concatenate([path, path[: more + 1]])
    return walk(path, n_frames, seed, EYE_HEIGHT_M, plan.turn_cost_m)


def loop_route(plan: LoopPlan) -> Route:
    """Return the ring of corridors as a route."""
    x, y = plan.half_x, plan.half_y
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    waypoints = np.column_stack([corners, np.full(4, EYE_HEIGHT_M)])
    return Route("lap", waypoints, True, plan.rounding_m, 1.6, floor_plan.CLEARANCE_M)


def build_loop(plan: LoopPlan, seed: int, run: int = 0) -> World:
    """Return the panels and lamps of the world, drawn from ``seed``; ``run`` moves a few light things."""
    places, path = spaces(plan), lap(plan)[::10]
    panels, lamps = [], []
    for number, space in enumerate(places):
        rng = np.random.default_rng([seed, number, 0x100F])
        others = [other for other in places if other is not space]
        panels += floor_plan.walls(rng, space, others)
        became = partial(change, seed, run, number)
        boxes, footprints = floor_plan.furniture(rng, space, path, plan.boxes_per_room, became)
        panels += [*boxes, *floor_plan.floor_and_ceiling(rng, space, others, footprints)]
        glowing, lights = floor_plan.lamps(rng, space)
        panels += glowing
        lamps += lights
    return World(tuple(panels), tuple(lamps), (0.5, 0.5, 0.52))
