"""Keeps a map within its budgets of keyframes and disk."""

from collections.abc import Callable, Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import MapConfig
from seamark.backend.map_prune import KEEP_SHARE, budget, choose, views_in
from seamark.backend.slam import Slam
from seamark.service.nodes.map_keeper import MapKeeper
from seamark.service.nodes.meter import Meter

EVERY: Final = 20  # keyframes
SPARED: Final = 20  # of the newest keyframes: loops of theirs may still wait for others
AT_ONCE: Final = 250  # keyframes forgotten in one go, so that nothing waits long for it


class MapPruner:
    """Forgets redundant keyframes in file, memory and graph, and tells of it (``forgotten``).

    What goes is chosen after one keyframe and goes after the next: keyframes and queries come in between. Not to be
    used while another thread maps.
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
        self._lightings: dict[int, NDArray[np.float64]] = {}  # of the views that there were when it was last looked
        self._chosen: frozenset[int] = frozenset()

    def mapped(self, keyframe_id: int) -> None:
        """Look at the budgets now and then, after a keyframe has been mapped."""
        if self._keeper.store.file.read_only:
            return
        if self._chosen:
            with self._meter.timed("prune"):
                self._forget()
        elif keyframe_id % EVERY == 0 and keyframe_id >= self._not_before:
            self._meter.keep("map_bytes", self._keeper.store.bytes_used())
            if budget(self._keeper.store, self._limits) is not None:
                with self._meter.timed("choose_views"):
                    self._choose(keyframe_id)

    def _choose(self, newest_id: int) -> None:
        """Choose what goes next, if anything can."""
        store, snapshot = self._keeper.store, self._slam.snapshot()
        keep = budget(store, self._limits, KEEP_SHARE) or 1
        self._lightings |= store.load_lightings(max(self._lightings, default=-1))
        views = views_in(snapshot, self._lightings)
        joined = ((loop.query_id, loop.match_id) for loop in snapshot.loops if loop.accepted)
        spared = {number for number in snapshot.keyframe_ids.tolist() if number > newest_id - SPARED}
        pruning = choose(views, keep, joined, self._limits, spared, AT_ONCE)
        # Maps of earlier versions have keyframes that went and left their poses.
        seen = {view.id for view in views}
        blind = [number for number in snapshot.keyframe_ids.tolist() if number not in seen]
        self._chosen = frozenset({*pruning.forget, *blind[:AT_ONCE]} - spared)
        self._meter.keep("views_over_budget", max(0, pruning.kept - pruning.wanted))
        if not self._chosen:
            self._not_before = newest_id + len(views) // 20

    def _forget(self) -> None:
        """Let go of what was chosen, in the file and in memory as one change."""
        change, chosen = self._slam.without(self._chosen), self._chosen
        self._chosen = frozenset()
        if not self._keeper.contract(change):
            return
        self._slam.adopt(change)
        self._meter.keep("map_bytes", self._keeper.store.bytes_used())
        self._forgotten(sorted(change.graph.gone))
        self._meter.count("views_forgotten", sum(number in self._lightings for number in chosen & change.graph.gone))
        for number in change.graph.gone:
            self._lightings.pop(number, None)
