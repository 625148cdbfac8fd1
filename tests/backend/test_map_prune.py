"""Pruning: a budget is kept as far as it can be, and every place keeps a view of each lighting."""

from pathlib import Path

import numpy as np
import pytest

from seamark.backend import map_prune, map_relations
from seamark.backend.config import BackendConfig, MapConfig
from seamark.backend.map_codec import lighting_of
from seamark.backend.map_prune import Pruning, View, choose
from seamark.backend.map_pruning import prune_map
from seamark.backend.map_store import MapStore

CONFIG = MapConfig(place_m=1.0, place_deg=20.0, lighting=0.12)
DAY, NIGHT = np.array([0.6, 0.6, 0.6, 0.2, 0.2, 0.2]), np.array([0.1, 0.1, 0.15, 0.1, 0.1, 0.1])


def view(number: int, x: float, heading_deg: float = 0.0, light: np.ndarray = DAY, component: int = 0) -> View:
    angle = np.deg2rad(heading_deg)
    return View(number, component, np.array([x, 0, 0]), np.array([np.cos(angle), np.sin(angle), 0]), light)


def stands(one: View, other: View) -> bool:
    """Say by itself whether one view may stand for another."""
    if one.component != other.component or one.position is None or other.position is None:
        return False
    near = np.linalg.norm(one.position - other.position) < 1.0
    assert one.direction is not None and other.direction is not None
    along = np.degrees(np.arccos(np.clip(one.direction @ other.direction, -1, 1))) < 20
    return bool(near and along and np.abs(one.lighting - other.lighting).max() < 0.12)


@pytest.mark.parametrize(("seed", "compared"), [(0, 2000), (1, 2000), (2, 30), (3, 30), (4, 1)])
def test_every_view_that_goes_has_one_that_stays(seed: int, compared: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test: all views compared at once, or a few places after the other. Expected: what stays stands for what went."""
    monkeypatch.setattr(map_prune, "COMPARED", compared)
    rng = np.random.default_rng(seed)
    views = [
        view(n, float(rng.uniform(0, 20)), float(rng.choice([0, 15, 90, 180])), DAY if rng.random() < 0.7 else NIGHT)
        for n in range(400)
    ]
    pruning = choose(views, 1, (), CONFIG)
    kept = [one for one in views if one.id not in set(pruning.forget)]
    assert pruning.kept == len(kept) and len(pruning.forget) + len(kept) == 400
    for one in views:
        assert any(stands(one, other) for other in kept)
    # Twenty metres, four ways of looking of which two are alike, two lightings: not many are needed.
    assert 2 * 3 * 10 <= len(kept) <= 2 * 3 * 20 + 40
    assert choose(views, 1, (), CONFIG).forget == pruning.forget


@pytest.mark.parametrize("at_once", [1, 700, 10**6])
def test_relations_are_those_of_each_pair(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_relations, "PAIRS_AT_ONCE", at_once)
    rng = np.random.default_rng(7)
    lights, ways = (DAY, DAY + 0.11, NIGHT), (0, 19, 21, 90)
    views = [
        view(n, float(x), float(rng.choice(ways)), lights[rng.integers(3)], int(rng.integers(2)))
        for n, x in enumerate(rng.uniform(-4, 4, 150))
    ]
    relations = map_relations.Relations(views, (), CONFIG)
    kept = rng.random(len(views)) < 0.7
    for rows in relations.blocks(40):
        relations.compare(rows, kept)
    assert sorted(relations.near) == list(range(len(views)))
    for row, one in enumerate(views):
        expected = [k for k, other in enumerate(views) if k != row and stands(one, other)]
        assert relations.near[row].tolist() == expected
        assert relations.stands_for[row] == sum(kept[k] for k in expected)


def test_at_most_so_many_go_at_once_and_none_that_is_spared() -> None:
    views = [view(n, 0.001 * n) for n in range(50)]
    pruning = choose(views, 10, (), CONFIG, spared=range(5), most=12)
    assert pruning.forget == tuple(range(5, 17)) and pruning.kept == 38


def test_a_budget_is_met_exactly_where_places_allow_it_and_the_oldest_go_first() -> None:
    laps = [view(10 * lap + place, 3.0 * place) for lap in range(5) for place in range(10)]
    pruning = choose(laps, 25, (), CONFIG)
    assert pruning.kept == 25 and set(pruning.forget) <= set(range(30))
    assert choose(laps, 100, (), CONFIG).forget == ()
    assert choose(laps, 3, (), CONFIG).kept == 10  # ten places, and no more can go


def test_lightings_and_components_are_places_of_their_own() -> None:
    views = [view(0, 0), view(1, 0, light=NIGHT), view(2, 0, component=1), view(3, 0, 90)]
    assert choose(views, 1, (), CONFIG).forget == ()


def test_a_map_without_views_has_none_to_forget(tmp_path: Path) -> None:
    """Test: a service was stopped before its first keyframe. Expected: its map is pruned like any other."""
    assert choose([], 10, (), CONFIG) == Pruning((), 0, 10)
    path = tmp_path / "map.seamark"
    with MapStore(path):
        pass
    assert prune_map(path, 10, BackendConfig()) == Pruning((), 0, 10)


def test_without_poses_loops_say_what_stands_for_what() -> None:
    views = [View(n, 0, None, None, DAY) for n in range(4)]
    assert choose(views, 1, [(2, 0), (3, 1)], CONFIG).forget == (0, 1)
    assert choose(views, 1, (), CONFIG).forget == ()


def test_lighting_is_mean_and_spread_of_the_colours() -> None:
    half = np.zeros((4, 4, 3), np.uint8)
    half[:2, :, 2] = 255
    np.testing.assert_allclose(lighting_of(half), [0, 0, 0.5, 0, 0, 0.5])
    np.testing.assert_allclose(lighting_of(np.full((2, 2), 51, np.uint8)), [0.2, 0.2, 0.2, 0, 0, 0])
