"""Pruning a map that no service has open."""

import logging
from pathlib import Path

from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapUnwritableError
from seamark.backend.map_open import loader, restore
from seamark.backend.map_prune import Pruning, choose, views_of
from seamark.backend.map_store import MapStore
from seamark.backend.slam import Slam
from seamark.backend.solver import SolverProcess
from seamark.frontend.types import Mode

logger = logging.getLogger(__name__)


def prune_map(path: Path, keyframes: int, config: BackendConfig) -> Pruning:
    """Forget redundant views until ``keyframes`` are left, as far as places allow; raises MapError.

    The last keyframe stays: the next one hangs on it. Nothing is solved. A disk without room for a second copy leaves
    the file as large as it was.
    """
    with MapStore(path, existing=True) as store:
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
        try:
            store.compact()
        except MapUnwritableError as error:
            logger.warning("%s; the file stays as large as it was, and what is free in it is used again", error)
    return pruning
