"""A map on disk into memory."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from seamark.backend.errors import MapError
from seamark.backend.map_reader import FEATURES
from seamark.backend.map_store import MapStore
from seamark.backend.slam import Slam
from seamark.frontend.types import Keyframe

MAPPED = "mapped"  # in the map's meta: the id of the last keyframe whose candidates have been seen to


def loader(store: MapStore, passing: MapStore | None = None) -> Callable[[int], Keyframe]:
    """Return a reader of keyframes' features, those of ``passing`` (see :func:`open_passing`) first."""

    def load(keyframe_id: int) -> Keyframe:
        if passing is not None:
            with suppress(MapError):
                return passing.keyframe(keyframe_id, (FEATURES,))
        return store.keyframe(keyframe_id, (FEATURES,))

    return load


def open_passing(path: Path) -> MapStore:
    """Return the file of sessions that pass through a map without becoming part of it.

    It holds their keyframes and the loops of these with the map's, which are not in it.
    """
    store = MapStore(path)
    with store.file.reading() as database:
        database.execute("PRAGMA foreign_keys = OFF")
    return store


def restore(
    slam: Slam, store: MapStore, *, held: bool = False, solve: bool = False
) -> tuple[list[Keyframe], list[Keyframe]]:
    """Take in what has been mapped; return these keyframes and those that are stored but wait to be mapped.

    The former are without features, the latter whole. ``held``: poses of the map are never changed. ``solve``: they are
    worked out anew, from odometry and loops.
    """
    meta = store.meta()
    mapped = int(meta.get(MAPPED, -1))
    nodes = store.load_nodes()
    before = [keyframe for keyframe in nodes if keyframe.id <= mapped]
    waiting = [store.keyframe(keyframe.id) for keyframe in nodes if keyframe.id > mapped]
    if before:
        loops = [loop for loop in store.load_loops() if loop.query_id <= mapped and loop.match_id <= mapped]
        if solve:
            slam.restore(before, loops)
            return before, waiting
        revision = int(meta.get("revision", 0))
        composed = (store.load_spans(), store.load_means(), store.load_adjustments())
        slam.restore(before, loops, store.load_poses(), revision, *composed, held=held)
    return before, waiting
