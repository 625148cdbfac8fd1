"""The world ``twins``: two corridors that look alike and are different places, joined to a ring by two that do not.

The second is the first turned by half a turn, panel by panel with the same pictures, so that a lap sees both from the
same side; a few posters differ, and the passages between them.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from seamark.datasets_synth import floor_plan, plain, prints
from seamark.datasets_synth.clutter import change
from seamark.datasets_synth.floor_plan import WALL_PIXELS_PER_METRE, Space
from seamark.datasets_synth.panels import Panel, moved
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.world import Lamp, World

HALF_LENGTH_M = 10.0
OUTER_M, INNER_M = 6.4, 3.6  # from the middle of the world to the walls of the corridors
PASSAGE_M = 2.6
HEIGHT_M = 2.6
EYE_M = 1.3
DIFFERENT_POSTERS = 2  # per long wall
FURNITURE = 6
FINISH = floor_plan.Finish(painted=0.35, linoleum=0.3, gaps_m=(0.2, 0.9))  # much to mistake for the same


def _spaces() -> tuple[Space, Space, Space]:
    """Return the first corridor, the passage in the east, the passage in the west."""
    end = HALF_LENGTH_M + PASSAGE_M
    corridor = Space(-HALF_LENGTH_M, HALF_LENGTH_M, INNER_M, OUTER_M, HEIGHT_M)
    east = Space(HALF_LENGTH_M, end, -OUTER_M, OUTER_M, HEIGHT_M + 0.3)
    return corridor, east, Space(-end, -HALF_LENGTH_M, -OUTER_M, OUTER_M, HEIGHT_M + 0.3)


def twins_route(_: str) -> Route:
    """Return the ring through both corridors."""
    x, y = HALF_LENGTH_M + PASSAGE_M / 2, (OUTER_M + INNER_M) / 2
    waypoints = np.array([[-x, -y, EYE_M], [x, -y, EYE_M], [x, y, EYE_M], [-x, y, EYE_M]])
    return Route("ring", waypoints, True, 1.2, 1.6, floor_plan.CLEARANCE_M)


def _with_other_posters(rng: np.random.Generator, panel: Panel) -> Panel:
    """Return the wall with a few posters of its own in place of what hangs there."""
    image = panel.image.copy()
    length = image.shape[1] / WALL_PIXELS_PER_METRE
    for place in (np.arange(DIFFERENT_POSTERS) + rng.uniform(0.2, 0.8, DIFFERENT_POSTERS)) / DIFFERENT_POSTERS:
        height, width = (int(rng.uniform(0.5, 0.9) * WALL_PIXELS_PER_METRE) for _ in range(2))
        row = int((HEIGHT_M - rng.uniform(1.5, 2.1)) * WALL_PIXELS_PER_METRE)
        column = int(min(place * length, length - 1.0) * WALL_PIXELS_PER_METRE)
        target = image[row : row + height, column : column + width]
        picture = plain.muted(prints.poster(rng, height, width), floor_plan.SATURATION)
        target[:] = picture[: target.shape[0], : target.shape[1]]
    return replace(panel, image=image)


def build_twins(_: str, seed: int, run: int = 0) -> World:
    """Return the world; ``run`` moves a few light things, in both corridors alike."""
    corridor, east, west = _spaces()
    middle = (OUTER_M + INNER_M) / 2
    rng = np.random.default_rng([seed, 0x7214])
    along = np.column_stack([np.linspace(-HALF_LENGTH_M, HALF_LENGTH_M, 200), np.full(200, middle)])
    walls = floor_plan.walls(rng, corridor, [east, west], FINISH)
    rest, footprints = floor_plan.furniture(rng, corridor, along, FURNITURE, partial(change, seed, run, 2))
    rest += floor_plan.floor_and_ceiling(rng, corridor, [east, west], footprints, FINISH)
    glowing, lights = floor_plan.lamps(rng, corridor)
    rest += glowing
    panels, nowhere = [*walls, *rest], np.zeros(3)
    lamps = [*lights, *(Lamp(lamp.position * (-1, -1, 1), lamp.colour) for lamp in lights)]
    panels += [moved(_with_other_posters(rng, panel), np.pi, nowhere) for panel in walls]
    panels += [moved(panel, np.pi, nowhere) for panel in rest]
    twin = Space(-HALF_LENGTH_M, HALF_LENGTH_M, -OUTER_M, -INNER_M, HEIGHT_M)
    across = np.column_stack([np.zeros(200), np.linspace(-OUTER_M, OUTER_M, 200)])
    for number, passage in enumerate((east, west)):
        own = np.random.default_rng([seed, number, 0x7215])
        panels += floor_plan.walls(own, passage, [corridor, twin])
        way = across + np.array([(passage.west + passage.east) / 2, 0.0])
        became = partial(change, seed, run, number)
        boxes, footprints = floor_plan.furniture(own, passage, way, FURNITURE // 2, became)
        panels += [*boxes, *floor_plan.floor_and_ceiling(own, passage, [corridor, twin], footprints)]
        glowing, lights = floor_plan.lamps(own, passage)
        panels += glowing
        lamps += lights
    return World(tuple(panels), tuple(lamps), (0.5, 0.5, 0.52))
