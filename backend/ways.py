"""The ways between two keyframes that lead through odometry and accepted loops."""

import heapq
from bisect import bisect_left, insort
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains, adjoint_stack
from seamark.backend.consistency import chi_squared, cycle_error, similarity
from seamark.backend.graph_types import Constraint

Matrix = NDArray[np.float64]
Hop = tuple[int, int, int | None]  # from, to, and the number of the loop passed, None for odometry

# A loop passed counts as so many steps of odometry, or the shortest way would zigzag through all of them.
LOOP_STEPS: Final = 10.0
ALL_AXES: Final = (0, 1, 2, 3, 4, 5)
PLANAR_AXES: Final = (2, 3, 4)  # the turn about z, and x and y


@dataclass(frozen=True, eq=False)
class Way:
    """A way from the match of a loop to its query, and how the loop agrees with it.

    ``loops`` are the numbers of the loops passed, ``chi2`` that of the cycle (6 dof, and scale), ``volume`` the root of
    the determinant of its covariance along the axes that can err: how little the way knows.
    """

    loops: tuple[int, ...]
    chi2: float
    volume: float


class Ways:
    """Keyframes at the ends of accepted loops, joined by odometry and by the loops.

    A way through loops knows more than odometry alone when it is shorter: so a loop is tested against all loops
    accepted near it at once, and not against each by itself.
    """

    def __init__(self, chains: OdometryChains, axes: tuple[int, ...] = ALL_AXES) -> None:
        self._chains, self._axes = chains, np.array(axes)
        self._loops: dict[int, Constraint] = {}
        self._at: dict[int, list[tuple[int, int]]] = {}  # stop -> (other end, number) of the loops that end there
        self._stops: dict[int, list[tuple[int, int]]] = {}  # session -> (step, stop), ascending
        self._beside: dict[int, tuple[tuple[int, int], ...]] = {}  # stop -> (next stop, steps) along the odometry

    def __contains__(self, number: int) -> bool:
        return number in self._loops

    def add(self, number: int, loop: Constraint) -> None:
        """Open a loop for ways."""
        self._loops[number] = loop
        for keyframe_id, other in ((loop.query_id, loop.match_id), (loop.match_id, loop.query_id)):
            if keyframe_id not in self._at:
                self._at[keyframe_id] = []
                stops = self._stops.setdefault(self._session(keyframe_id), [])
                insort(stops, self._stop(keyframe_id))
                place = bisect_left(stops, self._stop(keyframe_id))
                for step, stop in stops[max(place - 1, 0) : place + 2]:
                    self._beside[stop] = self._next_stops((step, stop), stops)
            self._at[keyframe_id].append((other, number))

    def odometry(self, loop: Constraint) -> Way | None:
        """Return the way through odometry alone; None between sessions."""
        if self._session(loop.query_id) != self._session(loop.match_id):
            return None
        return self._along_hops(loop, [(loop.match_id, loop.query_id, None)])

    def test(self, loop: Constraint, passable: Callable[[int], bool]) -> Way | None:
        """Return the shortest way for a loop, through passable loops only; None where there is none."""
        hops = self._shortest(loop.match_id, loop.query_id, passable)
        return None if hops is None else self._along_hops(loop, hops)

    def _along_hops(self, loop: Constraint, hops: list[Hop]) -> Way:
        """Return the way along these hops, from the loop's match to its query."""
        S, covariance, scale_variance = np.eye(4), np.zeros((6, 6)), 0.0
        for hop in reversed(hops):  # S maps the query's frame into the hop's end
            T, part, part_scale = self._hop(hop)
            Ad = adjoint_stack(np.linalg.inv(S)[None])[0]
            covariance += Ad @ part @ Ad.T
            scale_variance += part_scale
            S = T @ S
        error, log_scale = cycle_error((np.linalg.inv(S) @ similarity(loop))[None])
        covariance += loop.covariance
        chi2 = chi_squared(error, covariance[None], log_scale, np.array([scale_variance + loop.scale_sigma**2]))[0]
        volume = float(np.exp(0.5 * np.linalg.slogdet(covariance[self._axes[:, None], self._axes])[1]))
        return Way(tuple(number for *_, number in hops if number is not None), float(chi2), volume)

    def _hop(self, hop: Hop) -> tuple[Matrix, Matrix, float]:
        """Return the motion from the hop's end to its start, its covariance in the end's frame, and that of scale."""
        start, end, number = hop
        if number is None:
            odometry = self._chains.relative([start], [end])
            return odometry.T_a_b[0], odometry.covariance[0], float(odometry.scale_variance[0])
        loop = self._loops[number]
        S = similarity(loop)
        if loop.match_id == start:
            return S, loop.covariance, loop.scale_sigma**2
        Ad = adjoint_stack(S[None])[0]
        return np.asarray(np.linalg.inv(S)), Ad @ loop.covariance @ Ad.T, loop.scale_sigma**2

    def _shortest(self, start: int, end: int, passable: Callable[[int], bool]) -> list[Hop] | None:
        """Dijkstra's shortest path over the ends of loops, in steps of odometry."""
        best: dict[int, float] = {start: 0.0}
        came: dict[int, Hop] = {}
        queue, done = [(0.0, start)], set()
        session, goal = self._session(end), self._chains.step(end)
        while queue:
            cost, here = heapq.heappop(queue)
            if here in done:
                continue
            done.add(here)
            if here == end:
                return self._trace(came, start, end)
            reached: list[tuple[int, float, int | None]]
            reached = [(other, cost + steps, None) for other, steps in self._along(here)]
            reached += [(other, cost + LOOP_STEPS, n) for other, n in self._at.get(here, ()) if passable(n)]
            if self._session(here) == session:
                reached.append((end, cost + abs(goal - self._chains.step(here)), None))
            for other, length, passed in reached:
                if length < best.get(other, np.inf):
                    best[other] = length
                    came[other] = (here, other, passed)
                    heapq.heappush(queue, (length, other))
        return None

    def _along(self, keyframe_id: int) -> tuple[tuple[int, int], ...]:
        """Return the next stops along the odometry before and after a keyframe, and how many steps away they are."""
        if keyframe_id in self._beside:
            return self._beside[keyframe_id]
        return self._next_stops(self._stop(keyframe_id), self._stops.get(self._session(keyframe_id), []))

    def _next_stops(self, here: tuple[int, int], stops: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
        place = bisect_left(stops, here)
        after = place + 1 if place < len(stops) and stops[place] == here else place
        near = (stops[k] for k in (place - 1, after) if 0 <= k < len(stops))
        return tuple((stop, abs(step - here[0])) for step, stop in near)

    def _trace(self, came: dict[int, Hop], start: int, end: int) -> list[Hop]:
        """Return the hops from start to end, neighbouring ones along the odometry as one."""
        hops: list[Hop] = []
        while end != start:
            hop = came[end]
            if hops and hop[2] is None and hops[-1][2] is None:
                hop = (hop[0], hops.pop()[1], None)
            hops.append(hop)
            end = hop[0]
        return hops[::-1]

    def _session(self, keyframe_id: int) -> int:
        return self._chains.node(keyframe_id).session

    def _stop(self, keyframe_id: int) -> tuple[int, int]:
        return self._chains.step(keyframe_id), keyframe_id
