"""The worlds by name: how each is built from a seed, and the ways through it."""

from collections.abc import Callable
from dataclasses import dataclass

from seamark.datasets_synth import world_loop
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.world import World


@dataclass(frozen=True)
class Kind:
    """How a world is made. ``trajectory`` and ``frames`` are what is taken where nothing else is asked for."""

    build: Callable[[str, int], World]
    route: Callable[[str], Route]
    trajectory: str
    frames: int
    sizes: tuple[str, ...] = ("full",)


WORLDS = {
    "loop": Kind(
        lambda size, seed: world_loop.build_loop(world_loop.PLANS[size], seed),
        lambda size: world_loop.loop_route(world_loop.PLANS[size]),
        "lap",
        600,
        ("full", "small"),
    ),
}
