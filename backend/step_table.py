"""Loops by where they lie along the odometry."""

import numpy as np
from numpy.typing import NDArray

_FIRST_ROWS = 64


class StepTable:
    """Numbers of loops between two sessions with the steps of their query and match; columns that double."""

    def __init__(self) -> None:
        self._rows = np.zeros((_FIRST_ROWS, 3), np.int64)  # number, step of the query, step of the match
        self._count = 0

    def append(self, number: int, steps: tuple[int, int]) -> None:
        """Enter a loop."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = (number, *steps)
        self._count += 1

    def near(self, steps: tuple[int, int], reach: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the numbers (K,) of loops with both ends within reach, and the larger distance (K,) of each."""
        rows = self._rows[: self._count]
        apart = np.abs(rows[:, 1:] - np.array(steps)).max(axis=1)
        within = apart <= reach
        return rows[within, 0], apart[within]
