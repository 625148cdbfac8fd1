"""Keeps a map within its budgets of keyframes and disk."""

from collections.abc import Callable, Collection
from typing import Final

from seamark.backend.config import MapConfig
from seamark.backend.map_prune import KEEP_SHARE, budget, choose, views_of
from seamark.backend.slam import Slam
from seamark.service.nodes.map_keeper import MapKeeper
from seamark.service.nodes.meter import Meter

EVERY: Final = 20  # keyframes
SPARED: Final = 20  # of the newest keyframes: loops of theirs may still wait for others
AT_ONCE: Final = 500  # keyframes forgotten in one go, so that nothing waits long for it


class MapPruner:
    """Forgets redundant keyframes in file, memory and graph, and tells of it (``forgotten``).

    Not to be used while another thread maps.
    """

    def __init__(
        self,
        keeper: MapKeeper,
        slam: Slam,
        limits: MapConfig,
        meter: Meter,
        forgotten: Callable[[Collection[int]], object],
    ) -> None:
        self._keeper, self._slam, self._limits, self._meter, self._forgotten = keeper, slam, limits, meter, forgotten
        self._not_before = 0  # the keyframe up to which looking again is of no use

    def mapped(self, keyframe_id: int) -> None:
        """Look at the budgets now and then, after a keyframe has been mapped."""
        due = keyframe_id % EVERY == 0 and keyframe_id >= self._not_before
        if due and not self._keeper.store.file.read_only:
            self._prune(keyframe_id)

    def _prune(self, newest_id: int) -> None:
        store = self._keeper.store
        self._meter.keep("map_bytes", store.bytes_used())
        if budget(store, self._limits) is None:
            return
        with self._meter.timed("prune"):
            keep = budget(store, self._limits, KEEP_SHARE) or 1
            snapshot = self._slam.snapshot()
            joined = ((loop.query_id, loop.match_id) for loop in snapshot.loops if loop.accepted)
            views = views_of(store)
            spared = {number for number in snapshot.keyframe_ids.tolist() if number > newest_id - SPARED}
            pruning = choose(views, keep, joined, self._limits, spared, AT_ONCE)
            # Maps of earlier versions have keyframes that went and left their poses.
            seen = {view.id for view in views}
            blind = [number for number in snapshot.keyframe_ids.tolist() if number not in seen]
            gone = {*pruning.forget, *blind[:AT_ONCE]} - spared
            self._meter.keep("views_over_budget", max(0, pruning.kept - pruning.wanted))
            if not gone:
                self._not_before = newest_id + len(views) // 20
                return
            change = self._slam.without(gone)
            if not self._keeper.contract(change):
                return
            self._slam.adopt(change)
        self._meter.keep("map_bytes", store.bytes_used())
        self._forgotten(sorted(change.graph.gone))
        self._meter.count("views_forgotten", len(pruning.forget))
