"""Groups of loops that agree, and which of them are near to each other."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from seamark.backend.graph_types import Key
from seamark.backend.ways import Way


@dataclass(eq=False)
class Group:
    """Loops near to each other that agree: one observation of one place, however often it was made.

    ``middle`` is the finding that speaks for it, ``odometry`` its way through odometry alone, None where there is none.
    """

    number: int
    members: list[int] = field(default_factory=list)
    accepted: bool = False
    contradicted: bool = False  # by the way through what is accepted
    contested: bool = False  # by a group of comparable weight, which is left out as well
    middle: int = 0
    weight: float = 0.0
    odometry: Way | None = None


def near_pairs(keys: Sequence[Key], most: int) -> list[tuple[int, int]]:
    """Return pairs i > j of loops, each with its ``most`` nearest only: odometry says little of those far away."""
    ends = np.array(keys).reshape(-1, 2)
    pairs: set[tuple[int, int]] = set()
    for i in range(1, len(ends)):
        nearest = np.argsort(np.abs(ends[:i] - ends[i]).sum(axis=1), kind="stable")[:most]
        pairs |= {(i, j) for j in nearest.tolist()}
    return sorted(pairs)
