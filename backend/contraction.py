"""Pose graphs without some of their keyframes: what those said is composed into edges between the ones that stay.

A keyframe with its edges is a star. Marginalising its middle joins all its neighbours with each other; of these edges
the tree that tells most is kept (nonlinear factor recovery, Mazuran, Burgard and Tipaldi, IJRR 2016: for a star it is
the neighbour known best, to which all others are joined through the middle). The odometry stays a chain of its session.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import adjoint_stack, white_covariance
from seamark.backend.config import DriftConfig
from seamark.backend.consistency import chi_squared, cycle_error, similarity
from seamark.backend.graph_types import Constraint, Key, Node, Span
from seamark.frontend import se3

Matrix = NDArray[np.float64]
MOST_LOOPS: Final = 12  # of one keyframe; the loosest go first
SAME_CHI2: Final = 22.46  # 6 dof, 99.9 %: composed loops of one pair that differ by more are not averaged
MOST_AVERAGED: Final = 10  # measurements of one pair: systematic errors do not average out


@dataclass(frozen=True)
class Composed:
    """Where a composed loop comes from: the measured loop that weighs most in it, and how many it is the mean of."""

    origin: Key
    count: int


@dataclass(frozen=True, eq=False)
class Contraction:
    """A graph without the keyframes ``gone``.

    ``nodes`` stay, in their order; ``relinked`` are those of them whose predecessor has gone. ``loops`` are all of the
    graph; ``composed`` names those among them that are new or other than they were, ``dropped`` those between keyframes
    that stay which are no longer in it.
    """

    gone: frozenset[int]
    nodes: tuple[Node, ...]
    relinked: frozenset[int]
    loops: Mapping[Key, Constraint]
    composed: Mapping[Key, Composed]
    dropped: frozenset[Key]


def contract(
    nodes: Iterable[Node],
    loops: Iterable[Constraint],
    gone: Collection[int],
    drift: DriftConfig,
    counts: Mapping[Key, int] | None = None,
) -> Contraction:
    """Take keyframes out of a graph; nodes come in an order in which predecessors are first.

    ``counts`` are of how many measured loops each composed one is the mean. No keyframe keeps more than MOST_LOOPS
    loops, but for those that alone join two sessions.
    """
    graph = _Graph(nodes, loops, drift, counts or {})
    for number in sorted(gone):
        graph.remove(number)
    graph.thin()
    return graph.result()


@dataclass(frozen=True, eq=False)
class _Motion:
    """S (4, 4) = [sR t; 0 1] from the end's frame to the start's, its covariance in the end's frame."""

    S: Matrix
    covariance: Matrix
    scale_variance: float

    def back(self) -> "_Motion":
        Ad = adjoint_stack(self.S[None])[0]
        return _Motion(np.asarray(np.linalg.inv(self.S), np.float64), Ad @ self.covariance @ Ad.T, self.scale_variance)

    def then(self, other: "_Motion") -> "_Motion":
        Ad = adjoint_stack(np.linalg.inv(other.S)[None])[0]
        covariance = Ad @ self.covariance @ Ad.T + other.covariance
        return _Motion(self.S @ other.S, covariance, self.scale_variance + other.scale_variance)

    def volume(self) -> float:
        """Return the logarithm of the determinant of the covariance: how loose the motion is."""
        return float(np.linalg.slogdet(self.covariance)[1])


@dataclass(frozen=True, eq=False)
class _Edge:
    """A loop from query to match."""

    motion: _Motion  # from the query's frame to the match's
    origin: Composed
    volume: float
    changed: bool


class _Graph:
    """Nodes in chains, and loops by their ends."""

    def __init__(
        self, nodes: Iterable[Node], loops: Iterable[Constraint], drift: DriftConfig, counts: Mapping[Key, int]
    ) -> None:
        self._drift = drift
        self._nodes = {node.id: node for node in nodes}
        self._before: dict[int, int | None] = {}
        self._after: dict[int, set[int]] = {}
        self._gone: set[int] = set()
        self._relinked: set[int] = set()
        self._edges: dict[Key, _Edge] = {}
        self._at: dict[int, set[Key]] = {}
        last: dict[int, int] = {}
        for node in self._nodes.values():
            before = node.previous_id if node.previous_id is not None else last.get(node.session)
            self._before[node.id] = before
            if before is not None:
                self._after.setdefault(before, set()).add(node.id)
            last[node.session] = node.id
        for loop in loops:
            motion = _Motion(similarity(loop), loop.covariance, loop.scale_sigma**2)
            edge = _Edge(motion, Composed(loop.key, counts.get(loop.key, 1)), motion.volume(), False)
            self._put(loop.key, edge)
        self._given = frozenset(self._edges)

    def remove(self, number: int) -> None:
        """Take a node out; it stays where its session would fall apart."""
        before, after = self._before[number], sorted(self._after.get(number, ()))
        if before is None and len(after) > 1:
            return
        chain = [] if before is None else [(before, self._odometry(number))]
        chain += [(other, self._odometry(other).back()) for other in after]
        star = sorted(self._at.get(number, ()), key=lambda key: (self._edges[key].volume, key))
        spokes = [(self._other(key, number), self._spoke(key, number), self._edges[key].origin) for key in star]
        for key in star:
            self._drop(key)
        if spokes:
            hub, spoke, origin = spokes[0]
            to_hub = spoke.back()
            for end, other_spoke, own in spokes[1:]:
                self._join(end, hub, other_spoke.then(to_hub), Composed(own.origin, min(own.count, origin.count)))
            if chain and all(end != hub for end, _ in chain):
                end, motion = min(chain, key=lambda link: (link[1].volume(), link[0]))
                self._join(end, hub, motion.then(to_hub), Composed(origin.origin, 1))
        for other in after:
            self._relink(other, number, before)
        self._after.pop(number, None)
        if before is not None:
            self._after[before].discard(number)
        self._gone.add(number)
        del self._nodes[number], self._before[number]

    def thin(self) -> None:
        """Drop the loosest loops of keyframes that have too many."""
        if all(len(keys) <= MOST_LOOPS for keys in self._at.values()):
            return
        root: dict[int, int] = {}

        def find(session: int) -> int:
            while root.setdefault(session, session) != session:
                session = root[session]
            return session

        degree = dict.fromkeys(self._nodes, 0)
        for key in sorted(self._edges, key=lambda key: (self._edges[key].volume, key)):
            one, other = (find(self._nodes[number].session) for number in key)
            if one == other and max(degree[number] for number in key) >= MOST_LOOPS:
                self._drop(key)
                continue
            root[one] = other
            for number in key:
                degree[number] += 1

    def result(self) -> Contraction:
        loops, composed = {}, {}
        for key, edge in sorted(self._edges.items()):
            S, motion = edge.motion.S, edge.motion
            scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
            T = S.copy()
            T[:3, :3] = se3.orthonormalise(se3.make(S[:3, :3] / scale, S[:3, 3]))[:3, :3]
            covariance = 0.5 * (motion.covariance + motion.covariance.T)
            loops[key] = Constraint(*key, T, covariance, scale, float(np.sqrt(motion.scale_variance)))
            if edge.changed:
                composed[key] = edge.origin
        relinked = frozenset(self._relinked & set(self._nodes))
        stay = (key for key in self._given - set(loops) if not self._gone.intersection(key))
        nodes = tuple(self._nodes.values())
        return Contraction(frozenset(self._gone), nodes, relinked, loops, composed, frozenset(stay))

    def _odometry(self, number: int) -> _Motion:
        """Return the motion from a node's frame to its predecessor's, with all that odometry may be wrong by."""
        previous_id = self._before[number]
        assert previous_id is not None
        node, before = self._nodes[number], self._nodes[previous_id]
        T = se3.inverse(before.T_odom_cam) @ node.T_odom_cam
        steps = 1 if node.span is None else node.span.steps
        variance = 0.0 if node.metric else steps * self._drift.scale_per_keyframe**2
        return _Motion(T, white_covariance(node, T, self._drift), variance)

    def _relink(self, number: int, via: int, before: int | None) -> None:
        """Hang a node on the predecessor of its predecessor."""
        node, middle = self._nodes[number], self._nodes[via]
        self._before[number] = before
        self._relinked.add(number)
        if before is None:
            self._nodes[number] = replace(node, previous_id=None, covariance=np.zeros((6, 6)), span=None)
            return
        self._after[before].add(number)
        T_before_middle = se3.inverse(self._nodes[before].T_odom_cam) @ middle.T_odom_cam
        T_middle_node = se3.inverse(middle.T_odom_cam) @ node.T_odom_cam
        Ad = adjoint_stack(se3.inverse(T_middle_node)[None])[0]
        first, second = self._span(middle, T_before_middle), self._span(node, T_middle_node)
        span = Span(
            first.steps + second.steps,
            first.angle + second.angle,
            first.length + second.length,
            Ad @ first.drift @ Ad.T + second.drift,
        )
        covariance = Ad @ middle.covariance @ Ad.T + node.covariance
        self._nodes[number] = replace(node, previous_id=before, covariance=covariance, span=span)

    def _span(self, node: Node, motion: Matrix) -> Span:
        if node.span is not None:
            return node.span
        drift = white_covariance(node, motion, self._drift) - self._drift.covariance_inflation * node.covariance
        angle, length = float(se3.rotation_angle(motion[:3, :3])), float(np.linalg.norm(motion[:3, 3]))
        return Span(1, angle, length, drift)

    def _other(self, key: Key, number: int) -> int:
        return key[1] if key[0] == number else key[0]

    def _spoke(self, key: Key, middle: int) -> _Motion:
        """Return the motion from the middle's frame to that of the loop's other end."""
        motion = self._edges[key].motion
        return motion if key[0] == middle else motion.back()

    def _join(self, one: int, other: int, motion: _Motion, origin: Composed) -> None:
        """Enter a loop composed from ``one`` to ``other`` (the motion is from the latter's frame to the former's)."""
        if one == other:
            return
        key, motion = ((one, other), motion.back()) if one > other else ((other, one), motion)
        edge = _Edge(motion, origin, motion.volume(), True)
        known = self._edges.get(key)
        self._put(key, edge if known is None else _fused(known, edge))

    def _put(self, key: Key, edge: _Edge) -> None:
        self._edges[key] = edge
        for number in key:
            self._at.setdefault(number, set()).add(key)

    def _drop(self, key: Key) -> None:
        del self._edges[key]
        for number in key:
            self._at[number].discard(key)
            if not self._at[number]:
                del self._at[number]


def _fused(one: _Edge, other: _Edge) -> _Edge:
    """Return the mean of two measurements of one pair, the tighter one alone where they contradict each other.

    What they have in common (the way to a hub) is little; systematic errors are, so that the mean is never taken to be
    better than that of MOST_AVERAGED.
    """
    tight, loose = (one, other) if one.volume <= other.volume else (other, one)
    a, b = tight.motion, loose.motion
    error, log_scale = cycle_error((np.linalg.inv(a.S) @ b.S)[None])
    variance = np.array([a.scale_variance + b.scale_variance + 1e-12])
    if chi_squared(error, (a.covariance + b.covariance)[None], log_scale, variance)[0] > SAME_CHI2:
        return tight
    A, B = np.linalg.inv(a.covariance), np.linalg.inv(b.covariance)
    covariance = np.linalg.inv(A + B)
    step = covariance @ B @ error[0]
    S = a.S @ se3.make(se3.exp_rotation(step[:3]), step[3:])
    count = one.origin.count + other.origin.count
    covariance = covariance * max(1.0, count / MOST_AVERAGED)
    motion = _Motion(S, covariance, a.scale_variance)
    return _Edge(motion, Composed(tight.origin.origin, min(count, MOST_AVERAGED)), motion.volume(), True)
