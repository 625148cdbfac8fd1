"""What a renderer needs to know of a world."""

from dataclasses import dataclass

from seamark.datasets_synth.panels import Panel, Vector


@dataclass(frozen=True, eq=False)
class Lamp:
    """A point light without shadow: ``position`` (3,) m and ``colour`` RGB radiant intensity."""

    position: Vector
    colour: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Sun:
    """Light from afar without shadow: ``direction`` (3,) in which it shines, ``colour`` RGB radiance."""

    direction: Vector
    colour: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class World:
    """Panels and the light that falls on them by day; ``ambient`` is RGB.

    A world without ``sun`` is indoors, where lamps burn by day too. ``lamps_at_once`` above 0 lights no more than so
    many lamps, the nearest to the camera. Nothing is seen beyond ``far_m``.
    """

    panels: tuple[Panel, ...]
    lamps: tuple[Lamp, ...]
    ambient: tuple[float, float, float]
    sun: Sun | None = None
    lamps_at_once: int = 0
    far_m: float = 60.0
