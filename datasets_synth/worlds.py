"""The worlds by name: how each is built from a seed, and the ways through it."""

from collections.abc import Callable
from dataclasses import dataclass

from seamark.datasets_synth import world_hall, world_loop, world_office, world_road, world_street, world_twins
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.world import World


@dataclass(frozen=True)
class Kind:
    """How a world is made of size, seed and run.

    ``trajectory`` and ``frames`` are what is taken where nothing else is asked for.
    """

    build: Callable[[str, int, int], World]
    route: Callable[[str], Route]
    trajectory: str
    frames: int
    sizes: tuple[str, ...] = ("full",)


WORLDS = {
    "loop": Kind(
        lambda size, seed, run: world_loop.build_loop(world_loop.PLANS[size], seed, run),
        lambda size: world_loop.loop_route(world_loop.PLANS[size]),
        "lap",
        600,
        ("full", "small"),
    ),
    "twins": Kind(world_twins.build_twins, world_twins.twins_route, "loop", 790),
    "office": Kind(world_office.build_office, world_office.office_route, "loop", 750),
    "hall": Kind(world_hall.build_hall, world_hall.hall_route, "loop", 720),
    "street": Kind(world_street.build_street, world_street.street_route, "loop", 760),
    "road": Kind(world_road.build_road, world_road.road_route, "once", 800),
}
