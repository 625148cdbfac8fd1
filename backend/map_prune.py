"""Which views of a map can be forgotten, so that each place stays recognisable in each of its lightings."""

import heapq
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import MapConfig
from seamark.backend.map_store import MapStore

Vector = NDArray[np.float64]
KEEP_SHARE = 0.9  # of a budget, once it is exceeded: pruning shall be rare


@dataclass(frozen=True)
class View:
    """A keyframe that can be recognised. ``position`` and ``direction`` (3,) are None in a map without poses;
    ``lighting`` (6,) in 0..1 is the mean and spread of each colour of its thumbnail.
    """

    id: int
    component: int
    position: Vector | None
    direction: Vector | None
    lighting: Vector


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
        position, direction = (None, None) if T is None else (T[:3, 3], T[:3, 2])
        views.append(View(number, component, position, direction, lighting))
    return views


def choose(
    views: list[View],
    keep: int,
    joined: Iterable[tuple[int, int]],
    config: MapConfig,
    spared: Collection[int] = (),
    most: int | None = None,
) -> Pruning:
    """Choose views to forget until ``keep`` are left, the most redundant first and of these the oldest.

    Two views stand for one another when they are near, look the same way and in the same lighting; without poses,
    when an accepted loop joins them (``joined``). A view is forgotten only while another that stays stands for it, and
    for all that were forgotten in its favour: so every place keeps a view of each lighting, whatever the budget. Views
    in ``spared`` stay. At most ``most`` are forgotten at once.
    """
    alike = _alike(views, joined, config)
    alive = {view.id for view in views}
    stands_for = {number: len(others) for number, others in alike.items()}  # views that stay, beside itself
    queue = [(-count, number) for number, count in stands_for.items()]
    heapq.heapify(queue)
    forgotten: list[int] = []
    while queue and len(alive) > keep and (most is None or len(forgotten) < most):
        count, number = heapq.heappop(queue)
        if number not in alive or -count != stands_for[number] or number in spared:
            continue  # an entry from before
        if stands_for[number] < 1 or any(other not in alive and stands_for[other] < 2 for other in alike[number]):
            continue  # the last that stands for itself or for one that is gone
        alive.remove(number)
        forgotten.append(number)
        for other in alike[number]:
            stands_for[other] -= 1
            if other in alive:
                heapq.heappush(queue, (-stands_for[other], other))
    return Pruning(tuple(forgotten), len(alive), keep)


def budget(store: MapStore, config: MapConfig, share: float = 1.0) -> int | None:
    """Return how many views a map may keep if it exceeds its budget of keyframes or disk, else None."""
    count, used = len(store.keyframe_ids(recognisable=True)), store.bytes_used()
    disk = config.disk_mb << 20
    keep = count if used <= disk else int(count * share * disk / used)
    if count > config.keyframes:
        keep = min(keep, int(config.keyframes * share))
    return max(1, keep) if keep < count else None


def _alike(views: list[View], joined: Iterable[tuple[int, int]], config: MapConfig) -> Mapping[int, list[int]]:
    by_id = {view.id: view for view in views}
    alike: dict[int, list[int]] = {view.id: [] for view in views}
    for a, b in joined:
        one, other = by_id.get(a), by_id.get(b)
        if one is None or other is None or (one.position is not None and other.position is not None):
            continue
        if _same_lighting(one, other, config) and b not in alike[a]:
            alike[a].append(b)
            alike[b].append(a)
    cells: dict[tuple[int, ...], list[View]] = {}
    for view in views:
        if view.position is None or view.direction is None:
            continue
        cell = tuple(np.floor(view.position / config.place_m).astype(int).tolist())
        for offset in product((-1, 0, 1), repeat=3):
            there = (view.component, *(c + o for c, o in zip(cell, offset, strict=True)))
            for other in cells.get(there, ()):
                if _same_place(view, other, config) and _same_lighting(view, other, config):
                    alike[view.id].append(other.id)
                    alike[other.id].append(view.id)
        cells.setdefault((view.component, *cell), []).append(view)
    return alike


def _same_place(one: View, other: View, config: MapConfig) -> bool:
    assert one.position is not None and other.position is not None
    assert one.direction is not None and other.direction is not None
    near = float(np.linalg.norm(one.position - other.position)) < config.place_m
    return near and float(one.direction @ other.direction) > np.cos(np.deg2rad(config.place_deg))


def _same_lighting(one: View, other: View, config: MapConfig) -> bool:
    return float(np.abs(one.lighting - other.lighting).max()) < config.lighting
