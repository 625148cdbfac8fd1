"""The worlds by name: free ways through them, the same from the same seed, alike where they are meant to be."""

from collections import Counter

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import clutter, figures, movers, specification, world_office, world_road, world_twins
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.world import World
from seamark.datasets_synth.worlds import WORLDS

NEW = tuple(name for name in WORLDS if name != "loop")


@pytest.fixture(scope="module")
def worlds() -> dict[str, World]:
    return {name: specification.parse(name).build() for name in NEW}


def _distances(positions: np.ndarray, panel: Panel) -> np.ndarray:
    along = [(positions - panel.corner) @ edge / (edge @ edge) for edge in (panel.right, panel.down)]
    nearest = panel.corner + sum(
        np.clip(share, 0, 1)[:, None] * edge for share, edge in zip(along, (panel.right, panel.down), strict=True)
    )
    return np.linalg.norm(positions - nearest, axis=1)


@pytest.mark.parametrize("name", NEW)
def test_the_camera_keeps_clear_of_everything(name: str, worlds: dict[str, World]) -> None:
    positions = specification.parse(name).poses()[::4, :3, 3]
    nearest = [_distances(positions, panel).min() for panel in worlds[name].panels if not panel.sky]
    assert 0.3 < min(nearest) < 3.0


@pytest.mark.parametrize("name", NEW)
def test_a_world_depends_on_its_seed_only(name: str, worlds: dict[str, World]) -> None:
    again, other = (specification.parse(f"{name},seed={seed}").build() for seed in (0, 1))
    for a, b in zip(worlds[name].panels, again.panels, strict=True):
        assert np.array_equal(a.corner, b.corner)
        assert a.image.shape == b.image.shape
    for k in range(0, len(again.panels), max(1, len(again.panels) // 20)):
        assert np.array_equal(worlds[name].panels[k].image, again.panels[k].image)
    pairs = zip(worlds[name].panels, other.panels, strict=False)
    assert any(a.image.shape != b.image.shape or not np.array_equal(a.image, b.image) for a, b in pairs)
    assert specification.parse(name).poses().tobytes() == specification.parse(name).poses().tobytes()


@pytest.mark.parametrize("name", NEW)
def test_panels_are_rectangles_and_few(name: str, worlds: dict[str, World]) -> None:
    panels = worlds[name].panels
    assert 40 < len({id(panel.image) for panel in panels}) < 300
    for panel in panels:
        assert abs(panel.right @ panel.down) < 1e-6 * np.linalg.norm(panel.right) * np.linalg.norm(panel.down)
        assert panel.image.dtype == np.uint8 and panel.image.flags.c_contiguous


def test_a_bending_road_has_no_gaps(worlds: dict[str, World]) -> None:
    strips = [p for p in worlds["road"].panels if 0 <= p.corner[2] < 0.01 and abs(p.right[2]) + abs(p.down[2]) < 1e-9]
    bends = world_road.middle()[1:-1]
    assert len(strips) > len(bends)
    rng = np.random.default_rng(0)
    around = np.concatenate([bends + rng.uniform(-1, 1, bends.shape) * world_road.ROAD_M / 2 for _ in range(300)])
    onto = np.linalg.norm(around[:, None] - bends[None], axis=2).min(axis=1) < world_road.ROAD_M / 2 - 0.05
    points = np.column_stack([around[onto], np.zeros(int(onto.sum()))])
    covered = np.zeros(len(points), bool)
    for strip in strips:
        along = [(points - strip.corner) @ edge / (edge @ edge) for edge in (strip.right, strip.down)]
        covered |= np.all([(share >= 0) & (share <= 1) for share in along], axis=0)
    assert len(points) > 1000
    assert covered.all()


def test_closed_routes_close_within_their_frames() -> None:
    for name, kind in WORLDS.items():
        poses = specification.parse(name).poses()
        length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
        back = np.linalg.norm(poses[-100:, :3, 3] - poses[0, :3, 3], axis=1).min()
        assert 50 < length < 450
        assert (back < 5.0) == kind.route(kind.sizes[0]).closed


def test_twins_are_alike_but_for_posters(worlds: dict[str, World]) -> None:
    inside = [p for p in worlds["twins"].panels if abs(p.corners[:, 0].mean()) < world_twins.HALF_LENGTH_M - 0.01]
    north = [p for p in inside if p.corners[:, 1].min() >= world_twins.INNER_M - 0.01]
    south = [p for p in inside if p.corners[:, 1].max() <= -world_twins.INNER_M + 0.01]
    places = {tuple(np.round([*p.corner, *p.right], 6) + 0.0): p for p in north}
    turned = [tuple(np.round([*(p.corner * (-1, -1, 1)), *(p.right * (-1, -1, 1))], 6) + 0.0) for p in south]
    twins = [(places[key], p) for key, p in zip(turned, south, strict=True) if key in places]
    assert len(twins) > 20
    shares = [float((a.image != b.image).any(axis=-1).mean()) for a, b in twins]
    assert 0.01 < max(shares) < 0.2  # of a long wall
    assert np.mean(np.array(shares) == 0) > 0.8


def _where(panel: Panel, shift: float = 0.0) -> tuple[float, ...]:
    corner = panel.corner + np.array([shift, 0, 0])
    return tuple(np.round([*corner, *panel.right, *panel.down], 6) + 0.0)


def test_an_office_is_the_next_one_but_for_a_few_things(worlds: dict[str, World]) -> None:
    panels = worlds["office"].panels
    shared = Counter(id(panel.image) for panel in panels)
    assert sum(count >= 6 for count in shared.values()) > 40  # the same in all six rooms
    north = [panel for panel in panels if panel.corners[:, 1].min() > world_office.HALF_CORRIDOR_M]
    middle = {_where(p): p for p in north if abs(p.corners[:, 0].mean()) < world_office.PITCH_M / 2}
    east = [p for p in north if 0.5 < p.corners[:, 0].mean() / world_office.PITCH_M < 1.5]
    moved = [middle.get(_where(panel, -world_office.PITCH_M)) for panel in east]
    same = sum(a is not None and a.image is b.image for a, b in zip(moved, east, strict=True))
    assert 5 < len(east) - same < 20  # poster, number, carton; doors that are open there and shut here
    assert same > 40


class TestRuns:
    def test_between_runs_a_few_light_things_are_moved_or_gone(self, worlds: dict[str, World]) -> None:
        for name, least, most in (("office", 0.01, 0.15), ("street", 0.05, 0.4), ("hall", 0.05, 0.6)):
            first = {_where(panel) for panel in worlds[name].panels}
            second = [_where(panel) for panel in specification.parse(f"{name},run=1").build().panels]
            assert least < np.mean([place not in first for place in second]) + 1 - len(second) / len(first) < most
        third = {_where(panel) for panel in specification.parse("hall,run=2").build().panels}
        assert third != set(second)

    def test_walls_stay_and_all_keeps_clear_in_any_run(self) -> None:
        for name in ("loop,size=small,run=1", "office,run=1", "office,run=2"):
            wanted = specification.parse(name)
            positions = wanted.poses()[::8, :3, 3]
            assert 0.3 < min(_distances(positions, panel).min() for panel in wanted.build().panels) < 1

    def test_light_does_not_touch_geometry(self) -> None:
        day, night = (specification.parse(f"office,run=2,condition={light}").build() for light in ("day", "night"))
        assert [_where(panel) for panel in day.panels] == [_where(panel) for panel in night.panels]

    def test_what_became_of_things(self) -> None:
        assert clutter.change(0, 0, 5) == clutter.UNCHANGED
        fates = [clutter.change(3, 1, number) for number in range(2000)]
        assert fates == [clutter.change(3, 1, number) for number in range(2000)]
        gone, same = (np.mean([test(fate) for fate in fates]) for test in (lambda f: not f.present, _is_unchanged))
        assert 0.12 < gone < 0.18
        assert 0.46 < same < 0.54


def _is_unchanged(fate: clutter.Change) -> bool:
    return fate == clutter.UNCHANGED


class TestPeople:
    def test_they_are_of_human_size(self) -> None:
        for seed in range(5):
            parts = figures.person(np.random.default_rng(seed)).parts
            points = np.concatenate([mesh.vertices + part.joint for part in parts for mesh in part.meshes])
            assert 1.55 < points[:, 2].max() < 1.95
            assert abs(points[:, 2].min()) < 0.01
            assert 0.15 < np.abs(points[:, :2]).max() < 0.4

    def test_they_walk_without_jumping_and_keep_their_distance(self) -> None:
        poses = specification.parse("loop").poses()
        track = movers.track(poses, 15.0, 0.75, np.random.default_rng(3))
        here = track.present[1:] & track.present[:-1]
        steps = np.linalg.norm(np.diff(track.position[:, :2], axis=0), axis=1)[here]
        assert 0.5 < track.present.mean() < 0.95
        assert np.percentile(steps, 95) * 15 < 3.5
        away = np.linalg.norm(track.position[:, :2] - poses[:, :2, 3], axis=1)[track.present]
        assert 0.7 < away.min() < 1.5
        assert np.median(away) < 5

    def test_the_same_seed_gives_the_same_walk(self) -> None:
        poses = specification.parse("hall,frames=100").poses()
        one, two = (movers.track(poses, 15.0, 1.0, np.random.default_rng(5)) for _ in range(2))
        assert np.array_equal(one.position, two.position) and np.array_equal(one.present, two.present)


class TestSettings:
    def test_an_offset_moves_the_camera_to_its_left(self) -> None:
        plain, aside = (specification.parse(f"hall,frames=40{more}").poses() for more in ("", ",offset=50"))
        moved = np.einsum("nji,nj->ni", plain[:, :3, :3], aside[:, :3, 3] - plain[:, :3, 3])
        assert np.allclose(moved, (-0.5, 0, 0))

    def test_another_run_differs_in_the_same_world(self) -> None:
        first, second = (specification.parse(f"loop,frames=40,run={run}") for run in (0, 1))
        assert not np.array_equal(first.poses(), second.poses())
        assert np.abs(first.poses()[:, :3, 3] - second.poses()[:, :3, 3]).max() < 0.5
        assert first.seed == second.seed and first.motion_seed != second.motion_seed

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("hall,size=small", "no size=small"),
            ("road,trajectory=lap", "it is called once"),
            ("loop,condition=fog", "there are day, dusk, night, changing"),
            ("loop,camera=fisheye", "there are ideal, real, barrel"),
            ("loop,movers=9", "from 0 to 3"),
            ("loop,offset=-200", "from -100 to 100"),
            ("loop,crowd=60", "from 0 to 40"),
            ("loop,crowd=20,movers=1", "exclude each other"),
        ],
    )
    def test_bad_settings_say_what_exists(self, text: str, message: str) -> None:
        with pytest.raises(SeamarkError, match=message):
            specification.parse(text)

    def test_every_setting_changes_the_hash(self) -> None:
        texts = ["loop", "twins", "loop,condition=night", "loop,camera=real", "loop,movers=1", "loop,offset=5"]
        texts += ["loop,run=1", "loop,labels=1", "loop,trajectory=kidnap", "loop,crowd=30", "loop,labels=2"]
        assert len({specification.content_hash(specification.parse(text)) for text in texts}) == len(texts)
