"""The way that a world offers to a camera: what trajectories are made of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Route:
    """Where one may walk or drive through a world without touching anything.

    ``waypoints`` (N, 3) float64 m in the world (x forward, y left, z up), the height of the camera included; where
    ``closed`` is true the last one is joined to the first, which is not repeated. Corners may be rounded by up to
    ``corner_radius_m``; ``speed_m_s`` is the pace that suits the place. ``clearance_m`` is free of obstacles to either
    side of the polyline, at least.
    """

    name: str
    waypoints: NDArray[np.float64]
    closed: bool
    corner_radius_m: float
    speed_m_s: float
    clearance_m: float = 0.5
