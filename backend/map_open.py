"""A map on disk into memory."""

from collections.abc import Callable

from seamark.backend.map_store import FEATURES, MapStore
from seamark.backend.slam import Slam
from seamark.frontend.types import Keyframe

MAPPED = "mapped"  # in the map's meta: the id of the last keyframe whose candidates have been seen to


def loader(store: MapStore) -> Callable[[int], Keyframe]:
    """Return a reader of keyframes' features."""
    return lambda keyframe_id: store.keyframe(keyframe_id, (FEATURES,))


def restore(slam: Slam, store: MapStore, *, held: bool = False) -> tuple[list[Keyframe], list[Keyframe]]:
    """Take in what has been mapped; return these keyframes and those that are stored but wait to be mapped.

    The former are without features, the latter whole. ``held``: poses of the map are never changed.
    """
    meta = store.meta()
    mapped = int(meta.get(MAPPED, -1))
    nodes = store.load_nodes()
    before = [keyframe for keyframe in nodes if keyframe.id <= mapped]
    waiting = [store.keyframe(keyframe.id) for keyframe in nodes if keyframe.id > mapped]
    if before:
        loops = [loop for loop in store.load_loops() if loop.query_id <= mapped and loop.match_id <= mapped]
        revision = int(meta.get("revision", 0))
        composed = (store.load_spans(), store.load_means(), store.load_adjustments())
        slam.restore(before, loops, store.load_poses(), revision, *composed, held=held)
    return before, waiting
