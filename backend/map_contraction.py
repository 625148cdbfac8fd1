"""A map without some of its keyframes, and how the file of a map becomes it."""

import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from seamark.backend.adjustment import Adjustment
from seamark.backend.contraction import Contraction
from seamark.backend.graph_types import Key, Node
from seamark.backend.map_codec import decode_array, encode_array, encode_span, motion_between, sealed
from seamark.backend.map_schema import select, upsert
from seamark.backend.types import Loop, Reason

AT_ONCE = 500  # values of one statement


@dataclass(frozen=True)
class Mean:
    """Of how many measurements a composed loop is the mean, and the standard deviation of its log scale."""

    count: int
    scale_sigma: float


@dataclass(frozen=True, eq=False)
class Contracted:
    """What a map is without the keyframes ``graph.gone``.

    ``loops`` are the rows of the composed ones, ``components`` the frame of reference of each session that stays,
    ``adjustments`` what is left of those that stood; others have gone.
    """

    graph: Contraction
    loops: tuple[Loop, ...]
    components: Mapping[int, int]
    adjustments: tuple[Adjustment, ...] = ()

    def means(self) -> dict[Key, Mean]:
        """Return what is to be known of composed loops beside their rows."""
        composed, loops = self.graph.composed, self.graph.loops
        return {key: Mean(own.count, loops[key].scale_sigma) for key, own in composed.items()}

    def stays(self, key: Key) -> bool:
        """Return whether a loop of the map before is one of the map after."""
        return key not in self.graph.dropped and not self.graph.gone.intersection(key)


def contracted(
    graph: Contraction,
    loops: Mapping[Key, Loop],
    components: Mapping[int, int],
    adjustments: Iterable[Adjustment] = (),
) -> Contracted:
    """Return what becomes of loops, components (of each session, before) and adjustments that stand with the graph.

    Where the session in whose frame a component is has no keyframe any more, the next one names the frame.
    """
    stay = sorted({node.session for node in graph.nodes})
    names: dict[int, int] = {}
    for session in stay:
        names.setdefault(components[session], session)
    named = {session: names[components[session]] for session in stay}
    rows = []
    for key, own in graph.composed.items():
        loop = graph.loops[key]
        rows.append(
            replace(
                loops[own.origin],
                query_id=key[0],
                match_id=key[1],
                accepted=True,
                reason=Reason.ACCEPTED,
                T_match_query=loop.T_match_query,
                covariance=loop.covariance,
                scale=loop.scale,
                evidence=None,
            )
        )
    left = (one.contracted(graph) for one in adjustments)
    return Contracted(graph, tuple(rows), named, tuple(one for one in left if one is not None))


def write_nodes(database: sqlite3.Connection, change: Contracted) -> None:
    """Delete keyframes and what belongs to them, and hang those that stay on their new predecessors.

    Inside the caller's transaction; the composed loops are written after this.
    """
    gone = sorted(change.graph.gone)
    for marks, ids in _in_parts(gone):
        database.execute(f"DELETE FROM loops WHERE query_id IN ({marks}) OR match_id IN ({marks})", (*ids, *ids))
    database.executemany("DELETE FROM loops WHERE query_id = ? AND match_id = ?", sorted(change.graph.dropped))
    for node in change.graph.nodes:
        if node.id in change.graph.relinked:
            _relink(database, node)
    for marks, ids in _in_parts(gone):
        database.execute(f"DELETE FROM keyframes WHERE id IN ({marks})", ids)
    _sessions(database, change.components)


def write_means(database: sqlite3.Connection, means: Mapping[Key, Mean]) -> None:
    """Write what composed loops are made of; their rows are there."""
    rows = ((*map(int, key), int(mean.count), float(mean.scale_sigma)) for key, mean in means.items())
    database.executemany(upsert("composed"), [sealed("composed", row) for row in rows])


def _relink(database: sqlite3.Connection, node: Node) -> None:
    motion = None
    if node.previous_id is not None:
        query = "SELECT T_odom_cam FROM keyframes WHERE id = ?"
        poses = [decode_array(database.execute(query, (n,)).fetchone()[0]) for n in (node.previous_id, node.id)]
        motion = None if poses[0] is None or poses[1] is None else motion_between(poses[0], poses[1])
    covariance = None if motion is None else encode_array(node.covariance)
    values = (node.id, node.previous_id, encode_array(motion), covariance)
    database.execute(upsert("edges"), sealed("edges", values))
    if node.span is None:
        database.execute("DELETE FROM spans WHERE keyframe_id = ?", (node.id,))
    else:
        database.execute(upsert("spans"), sealed("spans", encode_span(node.id, node.span)))


def _sessions(database: sqlite3.Connection, components: Mapping[int, int]) -> None:
    """Delete sessions that have no keyframe any more; say of the others where they begin and what frame they are in."""
    first = dict(map(tuple, database.execute("SELECT session, min(id) FROM keyframes GROUP BY session").fetchall()))
    for number, first_id, stamp_ns, component, _ in database.execute(select("sessions")).fetchall():
        if number not in first:
            database.execute("DELETE FROM sessions WHERE id = ?", (number,))
            continue
        wanted = (number, first[number], stamp_ns, components.get(number, component))
        if wanted != (number, first_id, stamp_ns, component):
            database.execute(upsert("sessions"), sealed("sessions", wanted))


def _in_parts(ids: Collection[int]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield ids in parts, each with as many question marks."""
    ordered = tuple(map(int, ids))
    for start in range(0, len(ordered), AT_ONCE):
        part = ordered[start : start + AT_ONCE]
        yield ", ".join("?" * len(part)), part
