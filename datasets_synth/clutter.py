"""What becomes of light things between two runs in one world: most stay, some are moved, a few are gone."""

from dataclasses import dataclass

import numpy as np

GONE, MOVED = 0.15, 0.35
SHIFT_M, TURN_RAD = 0.3, 0.5  # one sigma


@dataclass(frozen=True)
class Change:
    """Whether a thing is still there, how far (m) it was moved along two directions, and by what angle turned."""

    present: bool = True
    along_m: float = 0.0
    across_m: float = 0.0
    turn_rad: float = 0.0


UNCHANGED = Change()


def change(seed: int, run: int, *thing: int) -> Change:
    """Return what became of the thing with such numbers by ``run``; in run 0 all is as the world was made."""
    if run == 0:
        return UNCHANGED
    rng = np.random.default_rng([seed, run, 0xC1A7, *thing])
    fate = rng.random()
    if fate < GONE:
        return Change(present=False)
    if fate < GONE + MOVED:
        return Change(True, rng.normal(0, SHIFT_M), rng.normal(0, SHIFT_M), rng.normal(0, TURN_RAD))
    return UNCHANGED
