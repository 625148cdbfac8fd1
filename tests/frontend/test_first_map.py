"""The first map from two views against the true motion, in scenes with depth and in one plane."""

import numpy as np
import pytest

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.first_map import first_map
from seamark.frontend.two_view import TwoView

CAMERA = Camera(640, 480, 500, 510, 320, 240)
NOISE_PX = 0.4


def room(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform((-2, -1.5, 2), (2, 1.5, 6), (200, 3))


def plane(rng: np.random.Generator, tilt: float = 0.5) -> np.ndarray:
    """Return points (200, 3) of a wall that is turned by ``tilt`` radians, 4 m away."""
    on_wall = np.column_stack([rng.uniform(-2, 2, 200), rng.uniform(-1.5, 1.5, 200), np.zeros(200)])
    return on_wall @ se3.exp_rotation(np.array([0.1, tilt, 0])).T + (0, 0, 4)


def motion(rotation: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    return se3.make(se3.exp_rotation(np.array(rotation)), np.array(translation))


def seen(points: np.ndarray, T_first_cam: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    ideal = CAMERA.project_ideal(se3.transform(se3.inverse(T_first_cam), points))
    return ideal + NOISE_PX * rng.normal(size=ideal.shape)


def map_of(
    points: np.ndarray, T_second: np.ndarray, T_between: np.ndarray | None = None, seed: int = 4
) -> TwoView | str:
    rng = np.random.default_rng(seed)
    return first_map(
        seen(points, np.eye(4), rng),
        seen(points, T_second, rng),
        CAMERA,
        min_parallax_px=18,
        min_landmarks=50,
        min_angle_deg=0.9,
        pixels_between=None if T_between is None else seen(points, T_between, rng),
    )


def errors_deg(result: TwoView, T: np.ndarray) -> tuple[float, float]:
    """Return the errors of the rotation and of the direction of the translation."""
    rotation = float(se3.rotation_angle(result.T_first_second[:3, :3].T @ T[:3, :3]))
    a, b = result.T_first_second[:3, 3], T[:3, 3]
    return np.rad2deg(rotation), np.rad2deg(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))


def test_two_views_start_a_map_of_unit_median_depth() -> None:
    T = motion((0.02, -0.06, 0.01), (0.6, 0.1, 0.15))
    result = map_of(room(np.random.default_rng(1)), T)
    assert not isinstance(result, str)
    assert np.nanmedian(result.landmarks[:, 2]) == pytest.approx(1, abs=0.02)
    rotation, direction = errors_deg(result, T)
    assert rotation < 0.5
    assert direction < 3


def test_pure_rotation_starts_no_map() -> None:
    """Test: the camera turns by 9 degrees on the spot. Expected: refused, in a word, never an invented translation."""
    for points in (room(np.random.default_rng(1)), plane(np.random.default_rng(1))):
        assert isinstance(map_of(points, motion((0.0, 0.16, 0.0), (0, 0, 0))), str)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.8])
def test_a_plane_starts_the_right_map_or_none(tilt: float, seed: int) -> None:
    """Test: a wall seen by a camera that moves aside, ahead and turns. Expected: the true motion, decided by the view
    between where two motions explain the others, or a refusal: never the other motion.
    """
    rng = np.random.default_rng(seed)
    T = motion((0.02, -0.12, 0.03), tuple(rng.uniform((0.6, -0.3, 0.2), (1.0, 0.3, 0.6))))
    between = motion((0.03, -0.07, 0.0), tuple(T[:3, 3] * 0.5 + rng.uniform(-0.1, 0.1, 3)))
    result = map_of(plane(rng, tilt), T, between, seed)
    if isinstance(result, str):
        assert result == "ambiguous_plane"
        return
    rotation, direction = errors_deg(result, T)
    assert rotation < 1.5
    assert direction < 8


def test_most_planes_are_decided_with_a_view_between_and_fewer_without() -> None:
    decided = {True: 0, False: 0}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = motion((0.02, -0.12, 0.03), tuple(rng.uniform((0.6, -0.3, 0.2), (1.0, 0.3, 0.6))))
        between = motion((0.03, -0.07, 0.0), tuple(T[:3, 3] * 0.5 + rng.uniform(-0.1, 0.1, 3)))
        points = plane(rng, 0.5)
        for with_view in decided:
            decided[with_view] += not isinstance(map_of(points, T, between if with_view else None, seed), str)
    assert 12 <= decided[True] <= 20
    assert 3 <= decided[False] < decided[True]
