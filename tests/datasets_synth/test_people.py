"""People: how they are built, where they walk, and what is known of their motion; without a simulator."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.datasets_synth import figures, optics, people, sensor, specification, studio
from seamark.datasets_synth.clearance import nearest_surface
from seamark.datasets_synth.crowd import FreeSpace, Planner
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.people import People
from seamark.datasets_synth.renderer import View
from seamark.datasets_synth.world import World
from seamark.frontend import se3
from seamark.frontend.camera import Rig

FPS = specification.FPS
OPEN_FRAMES = optics.MODELS["real"].shutter_s * optics.LONGEST_SHUTTER * FPS
WANTED = specification.parse("loop,trajectory=loop,frames=300,image=320x240,crowd=40,seed=6")


@pytest.fixture(scope="module")
def world() -> World:
    return WANTED.build()


@pytest.fixture(scope="module")
def crowd(world: World) -> People:
    return people.people_of(WANTED, world.panels)


def _steps(crowd: People, person: int) -> np.ndarray:
    track = crowd.tracks[person]
    return np.diff(track.position[:, :2], axis=0)[track.present[1:] & track.present[:-1]] * FPS


class TestCrowd:
    def test_nobody_runs_and_most_walk(self, crowd: People) -> None:
        speeds = np.concatenate([np.linalg.norm(_steps(crowd, k), axis=1) for k in range(len(crowd.tracks))])
        assert 4 <= len(crowd.tracks) <= 16
        assert 1.0 < speeds.max() < 2.3
        assert np.mean(speeds > 0.5) > 0.2
        assert 0.05 < np.mean(speeds < 0.15) < 0.8  # some stand for a while

    def test_they_walk_through_nothing_and_nobody(self, crowd: People, world: World) -> None:
        poses = WANTED.poses()
        for index in range(0, WANTED.frames, 5):
            places = np.array([track.position[index] for track in crowd.tracks if track.present[index]])
            if len(places) == 0:
                continue
            assert np.linalg.norm(places[:, :2] - poses[index, :2, 3], axis=1).min() > 0.6
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 9 * np.eye(len(places))
            assert apart.min() > 0.45
        walked = np.concatenate([track.position[track.present][::10] for track in crowd.tracks])
        assert nearest_surface(world.panels, walked + np.array([0, 0, 1.0])).min() > 0.15

    def test_they_are_not_glued_to_the_camera(self, crowd: People) -> None:
        poses = WANTED.poses()
        along, wandered = [], []
        for track in crowd.tracks:
            edges = np.flatnonzero(np.diff(np.concatenate([[False], track.present, [False]]).astype(int)))
            for begin, end in edges.reshape(-1, 2):
                seen = [se3.transform(se3.inverse(poses[k]), track.position[None, k])[0] for k in range(begin, end)]
                wandered.append(float(np.ptp(seen, axis=0).max()))
                middle = (begin + end - 1) // 2
                ahead = poses[middle, :2, 2]
                along.append(float((track.position[end - 1, :2] - track.position[begin, :2]) @ ahead))
        assert len(along) > 5
        assert np.median(wandered) > 1.0
        assert min(along) < -0.5 and max(along) > 0.5  # some come, some go along

    def test_the_same_seed_gives_the_same_crowd(self, crowd: People, world: World) -> None:
        again = people.people_of(WANTED, world.panels)
        assert all(
            a.position.tobytes() == b.position.tobytes() for a, b in zip(crowd.tracks, again.tracks, strict=True)
        )
        other = people.people_of(replace(WANTED, run=1), world.panels)
        assert crowd.tracks[0].position.tobytes() != other.tracks[0].position.tobytes()

    @pytest.mark.parametrize("share", [0.15, 0.4])
    def test_the_reckoned_share_is_the_one_asked_for(self, share: float) -> None:
        space = FreeSpace((), WANTED.poses())  # an open field
        planner = Planner(WANTED.poses(), WANTED.rig.cam0, FPS, space, share)
        planner.fill(np.random.default_rng(3))
        assert 0.9 * share < np.percentile(planner.shares, 95) < 1.1 * share
        assert planner.shares.max() < 1.16 * share
        assert np.median(planner.shares) > 0.2 * share

    def test_free_space_ends_at_walls(self) -> None:
        wall = Panel(
            np.array([3.0, 1.0, 2.0]), np.array([0, -2.0, 0]), np.array([0, 0, -2.0]), np.zeros((8, 8, 3), np.uint8)
        )
        space = FreeSpace((wall,), np.eye(4)[None])
        room = space.room(np.array([[0.0, 0], [2.5, 0], [3.0, 0.5], [40.0, 0]]))
        assert np.allclose(room[:3], (3.0, 0.5, 0.0), atol=0.15)
        assert room[3] == 0


class TestMotion:
    def test_displacements_carry_every_part_along(self, crowd: People) -> None:
        person = next(k for k, track in enumerate(crowd.tracks) if track.present[100:103].all())
        moved = crowd.displacements(100, 102)
        before, after = crowd.poses(person, 100), crowd.poses(person, 102)
        assert before is not None and after is not None
        for part in range(len(figures.PARTS)):
            assert np.allclose(moved[figures.label(person, part)] @ before[part], after[part], atol=1e-9)

    def test_who_is_missing_has_no_pose_and_no_displacement(self, crowd: People) -> None:
        person, last = next(
            (k, int(np.flatnonzero(track.present)[-1])) for k, track in enumerate(crowd.tracks) if not track.present[-1]
        )
        assert crowd.poses(person, last + 1) is None
        assert figures.label(person, 0) not in crowd.displacements(last, last + 1)

    def test_legs_swing_in_turn_and_stay_on_the_floor(self) -> None:
        body = figures.person(np.random.default_rng(1))
        feet = []
        for phase in np.linspace(0, 2 * np.pi, 24, endpoint=False):
            poses = body.poses(np.zeros(3), 0.0, float(phase), 1.2)
            feet.append([se3.transform(T, np.array([[0, 0, -0.48 * body.tall]]))[0] for T in poses[1:3]])
        forward = np.array(feet)[..., 0]
        assert np.allclose(forward[:, 0], -forward[:, 1], atol=1e-9)
        assert 0.25 < forward.max() < 0.6
        lift = np.array(feet)[..., 2]
        assert lift.min() > -0.01 and lift.max() < 0.15
        still = body.poses(np.zeros(3), 0.0, 1.0, 0.0)
        assert np.allclose(still[:, :3, :3], np.eye(3))

    def test_labels_of_parts_become_those_of_people(self) -> None:
        parts = np.array([[0, 1, 2, figures.label(0, 0), figures.label(0, 4), figures.label(13, 2)]], np.uint8)
        assert figures.whole_people(parts).tolist() == [[0, 1, 2, 10, 10, 23]]

    def test_skins_are_closed_and_face_outward(self) -> None:
        for part in figures.person(np.random.default_rng(2)).parts:
            for mesh in part.meshes:
                corners = mesh.vertices[mesh.triangles].astype(np.float64)
                volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
                assert 0.0005 < volume < 0.1  # negative if inside out
                faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                towards = np.einsum("ni,ni->n", faces, mesh.normals[mesh.triangles].mean(axis=1))
                assert np.mean(towards > 0) > 0.9

    def test_the_table_has_every_part_at_every_frame(self, crowd: People) -> None:
        rows = [line.split(",") for line in people.table(crowd, np.arange(WANTED.frames) * 10).splitlines()[1:]]
        assert len(rows) == len(figures.PARTS) * sum(int(track.present.sum()) for track in crowd.tracks)
        stamp, frame, person, label, part, *numbers = rows[len(rows) // 2]
        poses = crowd.poses(int(person), int(frame))
        assert poses is not None
        T = poses[figures.PARTS.index(part)]
        assert (int(stamp), int(label)) == (10 * int(frame), figures.label(int(person), figures.PARTS.index(part)))
        values = np.array(numbers, np.float64)
        assert np.allclose(values[:3], T[:3, 3], atol=1e-6)
        assert np.allclose(se3.from_quaternion(values[3:]), T[:3, :3], atol=1e-6)


class _FlatView:
    """Stands in for the renderer: a bright line, near for the right eye and far for the left."""

    NEAR_M, FAR_M, COLUMN = 0.8, 12.0, 290

    def __init__(self, world: World, rig: Rig, movers: object, *, meter: bool) -> None:
        self.shape = (rig.cam0.height, rig.cam0.width)

    def meter(self, _: np.ndarray) -> np.ndarray:
        return np.full((24, 32, 3), 60, np.float32)  # dark, so that the shutter is open for long

    def illuminate(self, _: object) -> None:
        return

    def render(self, _: np.ndarray, **wanted: object) -> View:
        assert wanted["right_depth"] is True
        line = np.full((*self.shape, 3), 30, np.float32)
        line[:, self.COLUMN] = 230
        left, right = (np.full(self.shape, depth, np.float32) for depth in (self.FAR_M, self.NEAR_M))
        return View(line, left, line.copy(), None, right)


def test_the_right_eye_is_blurred_by_what_it_sees_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line as wide in each eye as a point at its own depth moves while the shutter is open."""
    monkeypatch.setattr(studio, "Renderer", _FlatView)
    wanted = specification.parse("loop,trajectory=loop,image=320x240,frames=780,camera=real,sensors=stereo")
    index, camera = 90, wanted.rig.cam0
    frame = sensor.decode(studio.Studio(wanted).frame(index), 0, "")
    assert frame.image_right is not None
    poses = wanted.poses()
    T_later_now = se3.inverse(poses[index + 1]) @ poses[index]
    moved = []
    for image, depth, offset in ((frame.image, _FlatView.FAR_M, 0.0), (frame.image_right, _FlatView.NEAR_M, 0.12)):
        eye = se3.make(np.eye(3), np.array([offset, 0, 0]))
        T = se3.inverse(eye) @ T_later_now @ eye
        point = camera.rays(np.array([[_FlatView.COLUMN, 120.0]])) * depth
        whole = float(camera.project(se3.transform(T, point))[0, 0] - _FlatView.COLUMN)
        profile = image[110:130].astype(np.float64).mean(axis=(0, 2))
        light = np.maximum(profile - np.median(profile), 0)[_FlatView.COLUMN - 25 : _FlatView.COLUMN + 26]
        moved.append((abs(whole) * OPEN_FRAMES, float((light > 0.25 * light.max()).sum())))
    (far, far_seen), (near, near_seen) = moved
    assert near > 2 * far
    assert abs(near_seen - near) < 1.6
    assert abs(far_seen - max(1.0, far)) < 1.6
    assert near_seen > far_seen + 2
