"""What a renderer needs to know of a world."""

from dataclasses import dataclass

from seamark.datasets_synth.panels import Panel, Vector


@dataclass(frozen=True, eq=False)
class Lamp:
    """A point light without shadow: ``position`` (3,) m and ``colour`` RGB radiant intensity."""

    position: Vector
    colour: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class World:
    """Panels and the light that falls on them; ``ambient`` is RGB."""

    panels: tuple[Panel, ...]
    lamps: tuple[Lamp, ...]
    ambient: tuple[float, float, float]
