"""How near a camera comes to the surfaces of a world: ways that leave the route must not pass through walls."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import trajectories
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.specification import Specification

LEAST_M = 0.2


def nearest_surface(panels: Iterable[Panel], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (N,) m of positions (N, 3) from the nearest panel that is no sky."""
    nearest = np.full(len(positions), np.inf)
    for panel in panels:
        if panel.sky:
            continue
        outside = positions - panel.corner
        for edge in (panel.right, panel.down):
            outside = outside - np.clip((positions - panel.corner) @ edge / (edge @ edge), 0, 1)[:, None] * edge
        nearest = np.minimum(nearest, np.linalg.norm(outside, axis=1))
    return nearest


def require_clear(wanted: Specification) -> None:
    """Raise SeamarkError where a trajectory that leaves the route of its world would touch something there.

    Builds the world, which takes a second or two; trajectories that keep to the route are not looked at.
    """
    kind = trajectories.KINDS.get(wanted.trajectory)
    if kind is None or not kind.leaves_route:
        return
    distances = nearest_surface(wanted.build().panels, wanted.poses()[:, :3, 3])
    if distances.min() < LEAST_M:
        raise SeamarkError(
            f"trajectory={wanted.trajectory} would pass {distances.min():.2f} m from a surface of world {wanted.world} "
            f"at frame {int(distances.argmin())}: it needs an open area, such as that of the world hall"
        )
