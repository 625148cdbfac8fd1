"""Which views of a map can be forgotten, so that each place stays recognisable in each of its lightings."""

import heapq
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import MapConfig
from seamark.backend.map_relations import Relations, View
from seamark.backend.map_store import MapStore
from seamark.backend.types import MapSnapshot

__all__ = ["Pruning", "View", "budget", "choose", "views_in", "views_of"]

COMPARED: Final = 1000  # views of the densest places, whose relations are looked at together
KEEP_SHARE = 0.9  # of a budget, once it is exceeded: pruning shall be rare


@dataclass(frozen=True)
class Pruning:
    """Views to ``forget``, and ``kept`` of those there are; ``wanted`` fewer were asked for than can be kept."""

    forget: tuple[int, ...]
    kept: int
    wanted: int


def views_of(store: MapStore) -> list[View]:
    """Return the views of a map that can be recognised, by ascending id; no images are read."""
    poses, sessions, views = store.load_poses(), store.session_of_keyframes(), []
    for number, lighting in sorted(store.load_lightings().items()):
        T, component, _ = poses.get(number, (None, sessions[number], 1.0))
        views.append(_view(number, component, T, lighting))
    return views


def views_in(snapshot: MapSnapshot, lightings: Mapping[int, NDArray[np.float64]]) -> list[View]:
    """Return the views of a map in memory that can be recognised, those of ``lightings``, by ascending id."""
    posed: NDArray[np.bool_] = np.asarray(np.isfinite(snapshot.T_map_cam).all(axis=(1, 2)))
    return [
        _view(number, int(snapshot.components[row]), snapshot.T_map_cam[row] if posed[row] else None, lightings[number])
        for row, number in enumerate(snapshot.keyframe_ids.tolist())
        if number in lightings
    ]


def _view(number: int, component: int, T: NDArray[np.float64] | None, lighting: NDArray[np.float64]) -> View:
    return View(number, component, None if T is None else T[:3, 3], None if T is None else T[:3, 2], lighting)


def choose(
    views: list[View],
    keep: int,
    joined: Iterable[tuple[int, int]],
    config: MapConfig,
    spared: Collection[int] = (),
    most: int | None = None,
) -> Pruning:
    """Choose views to forget until ``keep`` are left: in the densest places, the most redundant first, then the oldest.

    Two views stand for one another when they are near, look the same way and in the same lighting; without poses,
    when an accepted loop joins them (``joined``). A view is forgotten only while another that stays stands for it, and
    for all that were forgotten in its favour: so every place keeps a view of each lighting, whatever the budget. Views
    in ``spared`` stay. At most ``most`` are forgotten at once.
    """
    relations = Relations(views, joined, config)
    kept = np.ones(len(views), bool)
    may_go = np.array([view.id not in spared for view in views], bool)
    wanted = len(views) - keep if most is None else min(len(views) - keep, most)
    forgotten: list[int] = []
    for rows in relations.blocks(COMPARED):
        if len(forgotten) >= wanted:
            break
        relations.compare(rows, kept)
        forgotten += _thin(relations, rows, kept, may_go, wanted - len(forgotten))
    return Pruning(tuple(views[row].id for row in forgotten), int(kept.sum()), keep)


def _thin(
    relations: Relations, rows: NDArray[np.intp], kept: NDArray[np.bool_], may_go: NDArray[np.bool_], most: int
) -> list[int]:
    """Forget up to ``most`` of these rows, whose relations are known, in ``kept``; return them in their order."""
    near, stands_for = relations.near, relations.stands_for
    queue = [(-int(stands_for[row]), int(row)) for row in rows if may_go[row]]
    heapq.heapify(queue)
    gone: list[int] = []
    while queue and len(gone) < most:
        count, row = heapq.heappop(queue)
        if -count != stands_for[row]:  # others of its place have gone since; it may be its turn later
            heapq.heappush(queue, (-int(stands_for[row]), row))
            continue
        others = near[row]
        last_of_gone = ~kept[others] & (stands_for[others] < 2)
        if stands_for[row] < 1 or last_of_gone.any():
            continue  # the last that stands for itself or for one that is gone
        kept[row] = False
        gone.append(row)
        stands_for[others] -= 1
    return gone


def budget(store: MapStore, config: MapConfig, share: float = 1.0) -> int | None:
    """Return how many views a map may keep if it exceeds its budget of keyframes or disk, else None."""
    count, used = len(store.keyframe_ids(recognisable=True)), store.bytes_used()
    disk = config.disk_mb << 20
    keep = count if used <= disk else int(count * share * disk / used)
    if count > config.keyframes:
        keep = min(keep, int(config.keyframes * share))
    return max(1, keep) if keep < count else None
