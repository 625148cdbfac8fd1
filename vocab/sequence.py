"""Order as evidence: of two ordered sets of images, those ways through the second that the first may have taken."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

MEMORY: Final = 0.95
"""What is left of the evidence of one image at the next: an influence over some twenty images to either side."""

UNEVEN_STEP: Final = 0.6  # cost, in standard deviations of a score, of standing still or going two places on
LOWEST, HIGHEST = -1.0, 5.0  # standardised scores are cut here: no single image may decide, nor be held against a way


def along_ways(scores: NDArray[np.floating]) -> NDArray[np.float64]:
    """Add to the score of each pair that of the best ways through it: (queries, places) to the same shape.

    ``scores`` (n, m) say how much query i looks like place j, both in the order in which they were taken; higher is
    better, in any unit. From one query to the next a way goes on by none, one or two places, all forward or all
    backward; one step is free. Sums run over the whole sequence in both directions and fade with distance, so that a
    way may begin and end anywhere (dynamic programming in place of the straight lines of SeqSLAM, Milford and Wyeth,
    ICRA 2012). The result is in standard deviations of the scores of one query.
    """
    if scores.size == 0:
        return np.zeros(scores.shape)
    spread = scores.std(axis=1, keepdims=True)
    unit = np.clip((scores - scores.mean(axis=1, keepdims=True)) / np.maximum(spread, 1e-9), LOWEST, HIGHEST)
    best = np.full(scores.shape, -np.inf)
    for direction in (1, -1):
        past = _gather(unit, direction)
        future = _gather(unit[::-1], -direction)[::-1]
        best = np.maximum(best, past + future - unit)
    return best


def _gather(unit: NDArray[np.float64], direction: int) -> NDArray[np.float64]:
    """Return for each pair (i, j) the faded sum along the best way that ends there."""
    gathered = unit.copy()
    for i in range(1, len(unit)):
        before = gathered[i - 1]
        best = before - UNEVEN_STEP  # standing still
        for step, cost in ((1, 0.0), (2, UNEVEN_STEP)):
            moved = np.full(len(before), -np.inf)
            if direction > 0:
                moved[step:] = before[: max(0, len(before) - step)]
            else:
                moved[: max(0, len(before) - step)] = before[step:]
            best = np.maximum(best, moved - cost)
        gathered[i] += MEMORY * best
    return gathered


def streaks(places: NDArray[np.integer], step: int) -> NDArray[np.int64]:
    """Return for each query how many successive ones, itself the last, found places of one island: (n,).

    ``places`` (n,) is the place that each query found, below 0 where it found none, which counts 0. Two places are of
    one island where they are at most ``step`` apart (temporal consistency: Galvez-Lopez and Tardos, T-RO 2012).
    """
    found = places >= 0
    goes_on = found[1:] & found[:-1] & (np.abs(np.diff(places)) <= step)
    lengths = found.astype(np.int64)
    for i in np.flatnonzero(goes_on):
        lengths[i + 1] = lengths[i] + 1
    return lengths


def reach(n: int) -> NDArray[np.float64]:
    """Return for each of ``n`` queries how many images, faded, :func:`along_ways` sums over: (n,)."""
    past = (1 - MEMORY ** (np.arange(n) + 1)) / (1 - MEMORY)
    return past + past[::-1] - 1
