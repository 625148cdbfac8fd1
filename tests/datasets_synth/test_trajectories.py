"""Camera motions: they keep their limits, are smooth, go where their name says, and come from a seed."""

import itertools

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import trajectories
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.spline import through, through_poses
from seamark.datasets_synth.trajectories import KINDS, frames_needed, limits, make_trajectory, measured, teleports
from seamark.frontend import se3

FPS = 15.0
RING = Route("ring", np.array([[-9, -5, 1.3], [9, -5, 1.3], [9, 5, 1.3], [-9, 5, 1.3]], float), True, 1.2, 1.4)
ROAD = Route("road", np.array([[0, 0, 1.5], [80, 0, 1.5], [120, 30, 1.5], [200, 30, 1.5]], float), False, 12.0, 8.0)
EVERYWHERE = [kind for kind in KINDS if kind not in ("loop", "figure_eight")]
CASES = [(kind, RING) for kind in KINDS] + [(kind, ROAD) for kind in EVERYWHERE]


def _whole(kind: str, route: Route, seed: int = 0) -> np.ndarray:
    return make_trajectory(kind, route, frames_needed(kind, route, FPS, seed), FPS, seed)


def _split(poses: np.ndarray, route: Route) -> list[np.ndarray]:
    return np.split(poses, teleports(poses, FPS, 3 * route.speed_m_s))


@pytest.mark.parametrize(("kind", "route"), CASES)
def test_limits_are_kept_and_used(kind: str, route: Route) -> None:
    allowed = limits(kind, route)
    poses = _whole(kind, route)
    assert np.allclose(np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, :3], np.eye(3), atol=1e-12)
    shares = []
    for block in _split(poses, route):
        speed, acceleration, rate = measured(block, FPS)
        assert speed <= 1.001 * allowed.speed_m_s
        assert acceleration <= 1.01 * allowed.acceleration_m_s2
        assert rate <= 1.001 * allowed.turn_rad_s
        shares.append(max(speed / allowed.speed_m_s, acceleration / allowed.acceleration_m_s2))
    assert max(shares) > 0.5  # neither are they kept by crawling


@pytest.mark.parametrize(("kind", "route"), CASES)
def test_acceleration_has_no_jumps(kind: str, route: Route) -> None:
    """At ten times the rate the greatest change of acceleration from sample to sample falls to about a tenth."""
    changes = []
    frames = frames_needed(kind, route, FPS, 0)
    for finer in (4, 40):
        poses = make_trajectory(kind, route, finer * (frames - 1) + 1, finer * FPS, 0)
        biggest = 0.0
        for block in np.split(poses, teleports(poses, finer * FPS, 3 * route.speed_m_s)):
            accelerations = np.diff(block[:, :3, 3], n=2, axis=0) * (finer * FPS) ** 2
            biggest = max(biggest, float(np.abs(np.diff(accelerations, axis=0)).max()))
        changes.append(biggest)
    assert changes[1] < 0.2 * changes[0]


@pytest.mark.parametrize("kind", list(KINDS))
def test_same_seed_same_bits(kind: str) -> None:
    first, second, other = (make_trajectory(kind, RING, 200, FPS, seed) for seed in (4, 4, 5))
    assert first.tobytes() == second.tobytes()
    assert np.abs(first - other).max() > 1e-3


def test_more_frames_slow_the_motion_and_fewer_cut_its_end() -> None:
    needed = frames_needed("loop", RING, FPS, 0)
    whole = make_trajectory("loop", RING, needed, FPS, 0)
    cut = make_trajectory("loop", RING, 100, FPS, 0)
    slow = make_trajectory("loop", RING, 2 * (needed - 1) + 1, FPS, 0)
    assert np.abs(cut - whole[:100]).max() < 0.02  # the whole takes no whole number of frames
    assert np.linalg.norm(slow[-1, :3, 3] - whole[-1, :3, 3]) < 0.02
    assert measured(slow, FPS)[0] == pytest.approx(0.5 * measured(whole, FPS)[0], rel=0.02)


def _ahead(poses: np.ndarray) -> np.ndarray:
    return poses[:, :3, 2]


def test_a_loop_comes_back_and_goes_on() -> None:
    poses = _whole("loop", RING)
    at_end = np.linalg.norm(poses[:80, :3, 3] - poses[-1, :3, 3], axis=1)
    assert at_end.min() < 0.25
    assert at_end[0] > 3.0  # the overlap
    assert 0.9 < float(_ahead(poses)[int(at_end.argmin())] @ _ahead(poses)[-1]) <= 1


def test_an_eight_crosses_itself_and_turns_both_ways() -> None:
    poses = _whole("figure_eight", RING)
    xy = poses[:, :2, 3]
    middle = np.linalg.norm(xy - xy.mean(axis=0), axis=1) < 1.0
    passes = np.flatnonzero(np.diff(middle.astype(int)) == 1)
    assert len(passes) == 2
    yaw = np.unwrap(np.arctan2(_ahead(poses)[:, 1], _ahead(poses)[:, 0]))
    assert np.ptp(yaw) > np.pi
    assert abs(yaw[int(np.linalg.norm(xy[200:] - xy[0], axis=1).argmin()) + 200] - yaw[0]) < 0.5


def test_there_and_back_sees_every_place_in_both_directions() -> None:
    poses = _whole("there_and_back", ROAD)
    middle = int(np.argmax(poses[:, 0, 3]))
    moving = np.flatnonzero(np.linalg.norm(np.diff(poses[middle:, :3, 3], axis=0), axis=1) > 0.2) + middle
    for late in poses[moving[30:-30:40]]:
        nearest = int(np.linalg.norm(poses[: middle - 20, :3, 3] - late[:3, 3], axis=1).argmin())
        assert np.linalg.norm(poses[nearest, :3, 3] - late[:3, 3]) < 0.6
        assert poses[nearest, :3, 2] @ late[:3, 2] < -0.97


@pytest.mark.parametrize("route", [RING, ROAD])
def test_a_lawn_mower_alternates(route: Route) -> None:
    poses = _whole("lawn_mower", route)
    along = _ahead(poses)[:, 0]
    assert 2 <= np.count_nonzero(np.diff(np.sign(along[np.abs(along) > 0.8]))) <= 6


def test_stops_stand_still() -> None:
    poses = _whole("stop_and_go", RING)
    standing = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) < 1e-4
    starts = np.flatnonzero(np.diff(standing.astype(int)) == 1)
    assert 5 <= len(starts) <= 7
    assert 0.05 < standing.mean() < 0.5


def test_a_pure_rotation_is_one_about_the_optical_centre() -> None:
    poses = _whole("pure_rotation", RING)
    angles = se3.rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    still = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) < 1e-9
    assert float(angles[still].sum()) == pytest.approx(4 * np.pi, rel=0.02)


def test_a_kidnapped_camera_jumps_twice_and_comes_home() -> None:
    poses = _whole("kidnap", RING)
    first, second = teleports(poses, FPS, 3 * RING.speed_m_s)
    ahead, back = poses[first, :3, 3], poses[second, :3, 3]
    assert np.linalg.norm(poses[:first, :3, 3] - ahead, axis=1).min() > 3
    assert np.linalg.norm(poses[:first, :3, 3] - back, axis=1).min() < 0.3
    assert np.linalg.norm(back - poses[second - 1, :3, 3]) > 3


def test_a_second_traversal_is_aside_and_looks_aside() -> None:
    first = _whole("loop", RING)
    second = _whole("second_traversal", RING, 1)
    offsets, angles = [], []
    for pose in second[20:-20:10]:
        nearest = int(np.linalg.norm(first[:, :2, 3] - pose[:2, 3], axis=1).argmin())
        offsets.append(float(np.linalg.norm(first[nearest, :2, 3] - pose[:2, 3])))
        angles.append(float(se3.rotation_angle(first[nearest, :3, :3].T @ pose[:3, :3])))
    assert 0.08 < np.median(offsets) < 0.4
    assert np.deg2rad(1) < np.median(angles) < np.deg2rad(9)
    assert not np.array_equal(_whole("second_traversal", RING, 2)[:50], second[:50])


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not KINDS[kind].leaves_route])
def test_the_camera_stays_within_the_clearance(kind: str) -> None:
    corners = np.concatenate([RING.waypoints, RING.waypoints[:1]])[:, :2]
    xy = _whole(kind, RING, 7)[:, :2, 3]
    distances = []
    for a, b in itertools.pairwise(corners):
        share = np.clip((xy - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        distances.append(np.linalg.norm(a + share[:, None] * (b - a) - xy, axis=1))
    arc = RING.corner_radius_m * (np.sqrt(2) - 1)
    assert np.min(distances, axis=0).max() < max(arc, RING.clearance_m) + 0.1


@pytest.mark.parametrize(
    ("kind", "route", "frames", "message"),
    [
        ("zigzag", RING, 100, "there is no trajectory 'zigzag'; there are loop"),
        ("loop", ROAD, 100, "does not come back to its start, so there is no loop"),
        ("figure_eight", ROAD, 100, "no figure_eight"),
        ("loop", RING, 1, "two frames"),
    ],
)
def test_what_cannot_be_is_refused(kind: str, route: Route, frames: int, message: str) -> None:
    with pytest.raises(SeamarkError, match=message):
        make_trajectory(kind, route, frames, FPS, 0)


def test_splines_pass_through_their_points_and_know_their_derivatives() -> None:
    rng = np.random.default_rng(0)
    knots = np.cumsum(rng.uniform(0.02, 0.1, 60))
    curve = through(knots, np.stack([np.sin(3 * knots), np.cos(2 * knots)], axis=1))
    assert np.allclose(curve(knots)[:, 0], np.sin(3 * knots), atol=1e-12)
    t = np.linspace(knots[5], knots[-6], 500)
    assert np.abs(curve(t, 1)[:, 0] - 3 * np.cos(3 * t)).max() < 1e-3
    assert np.abs(curve(t, 2)[:, 1] + 4 * np.cos(2 * t)).max() < 0.02
    with pytest.raises(SeamarkError, match="ascending"):
        through(knots[::-1], np.zeros((60, 2)))


def test_angular_velocity_is_that_of_the_rotations() -> None:
    poses = _whole("six_dof", RING)
    times = np.arange(len(poses)) / FPS
    motion = through_poses(times, poses)
    at, h = np.linspace(1, 20, 300), 1e-5
    before, after = motion.poses(at - h), motion.poses(at + h)
    steps = np.stack([se3.log_rotation(a[:3, :3].T @ b[:3, :3]) for a, b in zip(before, after, strict=True)])
    assert np.abs(motion.angular_velocity(at) - steps / (2 * h)).max() < 1e-5
    assert np.allclose(motion.poses(times), poses, atol=1e-9)
    assert trajectories.measured(poses, FPS)[2] > 0.2
