"""Which views of a map may stand for one another: near, looking the same way, in the same lighting."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import MapConfig

Vector = NDArray[np.float64]
Rows = NDArray[np.intp]
PAIRS_AT_ONCE: Final = 400_000
NOWHERE: Final = -1  # the cell of views without a pose
LIGHTING: Final = 6  # numbers that say in which lighting a view was taken


@dataclass(frozen=True)
class View:
    """A keyframe that can be recognised. ``position`` and ``direction`` (3,) are None in a map without poses;
    ``lighting`` (6,) in 0..1 is the mean and spread of each colour of its thumbnail.
    """

    id: int
    component: int
    position: Vector | None
    direction: Vector | None
    lighting: Vector


def _squared_distances(ones: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared distances (n, m) of points (n, 3) and (m, 3) that are near to each other."""
    middle = ones.mean(axis=0)  # far from the origin their squares would drown the differences
    a, b = ones - middle, others - middle
    return np.asarray((a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * (a @ b.T))


class Relations:
    """The views that may stand for each view, by rows; found for those rows only that are asked for (``compare``).

    Of a row that was compared, ``near`` has the rows that may stand for it, ascending, and ``stands_for`` how many of
    them are kept. Without poses accepted loops (``joined``, pairs of ids) say it instead.
    """

    def __init__(self, views: list[View], joined: Iterable[tuple[int, int]], config: MapConfig) -> None:
        count = len(views)
        self._config = config
        self._lighting = np.array([view.lighting for view in views], np.float64).reshape(count, LIGHTING)
        self._posed = np.array([view.position is not None for view in views], bool)
        self._position, self._direction = np.zeros((count, 3)), np.zeros((count, 3))
        for row, view in enumerate(views):
            if view.position is not None and view.direction is not None:
                self._position[row], self._direction[row] = view.position, view.direction
        self._members, self._cell_of = self._cells(np.array([view.component for view in views], np.int64))
        self._joined = self._joined_rows({view.id: row for row, view in enumerate(views)}, joined)
        self.near: dict[int, Rows] = {}
        self.stands_for = np.zeros(count, np.int64)

    def blocks(self, size: int) -> Iterator[Rows]:
        """Yield all rows in blocks of whole cells with ``size`` rows or a cell more, the fullest cells first."""
        block: list[Rows] = []
        for cell in sorted(self._members, key=lambda cell: (-len(self._members[cell]), cell)):
            block.append(self._members[cell])
            if sum(map(len, block)) >= size:
                yield np.sort(np.concatenate(block))
                block = []
        if block:
            yield np.sort(np.concatenate(block))

    def compare(self, rows: Rows, kept: NDArray[np.bool_]) -> None:
        """Find what stands for these rows."""
        for cell in sorted({self._cell_of[row] for row in rows.tolist()}):
            mine = self._members[cell]
            if cell[0] == NOWHERE:
                for row in mine.tolist():
                    self.near[row] = np.array(sorted(self._joined.get(row, ())), np.intp)
            else:
                self._compare_cell(mine, self._around(cell))
        for row in rows.tolist():
            self.stands_for[row] = np.count_nonzero(kept[self.near[row]])

    def _compare_cell(self, rows: Rows, others: Rows) -> None:
        config, at_once = self._config, max(1, PAIRS_AT_ONCE // len(others))
        for start in range(0, len(rows), at_once):
            part = rows[start : start + at_once]
            alike = self._direction[part] @ self._direction[others].T > np.cos(np.deg2rad(config.place_deg))
            alike &= _squared_distances(self._position[part], self._position[others]) < config.place_m**2
            alike &= part[:, None] != others[None]
            one, other = np.nonzero(alike)
            light = np.abs(self._lighting[part[one]] - self._lighting[others[other]]).max(axis=1) < config.lighting
            one, other = one[light], others[other[light]]
            ends = np.searchsorted(one, np.arange(len(part) + 1))
            for k, row in enumerate(part.tolist()):
                near = other[ends[k] : ends[k + 1]]
                extra = self._joined.get(row)  # with one that has no pose
                self.near[row] = near if extra is None else np.union1d(near, np.array(sorted(extra), np.intp))

    def _cells(self, components: NDArray[np.int64]) -> tuple[dict[tuple[int, ...], Rows], list[tuple[int, ...]]]:
        """Return the rows of each cell (component and place), ascending, and the cell of each row."""
        place = np.floor(self._position / self._config.place_m).astype(np.int64)
        keys = np.column_stack([np.where(self._posed, components, NOWHERE), place])
        keys[~self._posed, 1:] = 0
        cell_of = list(map(tuple, keys.tolist()))
        members: dict[tuple[int, ...], list[int]] = {}
        for row, cell in enumerate(cell_of):
            members.setdefault(cell, []).append(row)
        return {cell: np.array(rows, np.intp) for cell, rows in members.items()}, cell_of

    def _around(self, cell: tuple[int, ...]) -> Rows:
        """Return the rows of a cell and its neighbours, ascending."""
        component, *place = cell
        found = [
            self._members.get((component, *(c + o for c, o in zip(place, offset, strict=True))))
            for offset in product((-1, 0, 1), repeat=3)
        ]
        return np.sort(np.concatenate([rows for rows in found if rows is not None]))

    def _joined_rows(self, row_of: dict[int, int], joined: Iterable[tuple[int, int]]) -> dict[int, set[int]]:
        """Return for each row without a pose, or joined with one, the rows that loops say are the same place."""
        found: dict[int, set[int]] = {}
        for pair in joined:
            if pair[0] not in row_of or pair[1] not in row_of:
                continue
            a, b = row_of[pair[0]], row_of[pair[1]]
            if self._posed[a] and self._posed[b]:
                continue
            if np.abs(self._lighting[a] - self._lighting[b]).max() < self._config.lighting:
                found.setdefault(a, set()).add(b)
                found.setdefault(b, set()).add(a)
        return found
