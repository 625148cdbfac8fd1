"""Pruning a map that no service has open."""

from pathlib import Path

from seamark.backend.config import BackendConfig
from seamark.backend.map_open import loader, restore
from seamark.backend.map_prune import Pruning, choose, views_of
from seamark.backend.map_store import MapStore
from seamark.backend.slam import Slam
from seamark.backend.solver import SolverProcess
from seamark.frontend.types import Mode


def prune_map(path: Path, keyframes: int, config: BackendConfig) -> Pruning:
    """Forget redundant views until ``keyframes`` are left, as far as places allow; raises MapError.

    The last keyframe stays: the next one hangs on it. Nothing is solved.
    """
    with MapStore(path) as store:
        mode = Mode(store.meta().get("mode", Mode.RGBD))
        solver = None if mode is Mode.PLACES else SolverProcess(config)  # it is asked nothing, so it never starts
        slam = Slam(config, mode, solver, 0, loader(store))
        before, waiting = restore(slam, store)
        known = {keyframe.id for keyframe in before}
        newest = {keyframe.previous_id for keyframe in waiting} | {max(known, default=-1)}
        spared = {number for number in newest | {keyframe.id for keyframe in waiting} if number is not None}
        joined = [(loop.query_id, loop.match_id) for loop in slam.snapshot().loops if loop.accepted]
        views = views_of(store)
        pruning = choose(views, keyframes, joined, config.map, spared)
        blind = known - {view.id for view in views}
        change = slam.without({*pruning.forget, *blind} - spared)
        store.contract(change)
        store.compact()
    return pruning
