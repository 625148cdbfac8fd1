"""Spatial evidence on features whose true motion is known."""

import numpy as np
import pytest

from seamark.vocab.errors import ObservationError
from seamark.vocab.kernels import native
from seamark.vocab.spatial import LocalFeatures, compare

WIDTH, HEIGHT = 640, 480
TOLERANCE, SCALE_STEP, MOST_TURN = 40.0, 0.7, 0.5


def mutual_reference(rows: np.ndarray, columns: np.ndarray) -> list[list[int]]:
    """Mutual nearest neighbours with the distance to the nearest and to the next, from all distances."""
    squared = ((rows[:, None].astype(int) - columns[None]) ** 2).sum(axis=2)
    nearest, back = squared.argmin(axis=1), squared.argmin(axis=0)
    ordered = np.sort(squared, axis=1)
    return [[i, int(j), int(ordered[i, 0]), int(ordered[i, 1])] for i, j in enumerate(nearest) if back[j] == i]


@pytest.mark.parametrize("level", native.levels())
@pytest.mark.parametrize(("n", "m"), [(1, 2), (3, 17), (70, 64), (33, 300)])
def test_mutual_neighbours_equal_those_of_all_distances(level: str, n: int, m: int) -> None:
    rng = np.random.default_rng(n + m)
    columns = rng.integers(0, 256, (m, 128), dtype=np.uint8)
    rows = rng.integers(0, 256, (n, 128), dtype=np.uint8)
    rows[: min(n, m) // 2] = columns[: min(n, m) // 2] ^ rng.integers(0, 8, (min(n, m) // 2, 128), dtype=np.uint8)
    rows[n // 2 : n // 2 + 2] = columns[0]  # equally near: the first counts
    assert native.mutual(rows, columns, level).tolist() == mutual_reference(rows, columns)


def test_the_similarity_is_the_one_that_most_agree_with() -> None:
    rng = np.random.default_rng(3)
    for count in (0, 1, 2, 60):
        x, y, to_x, to_y = rng.uniform(0, 500, (4, count)).astype(np.float32)
        log_scale, turn = rng.normal(0, 0.5, count).astype(np.float32), rng.normal(0, 0.4, count).astype(np.float32)
        together = count // 3
        to_x[:together], to_y[:together] = 1.2 * x[:together] + 30, 1.2 * y[:together] - 8
        log_scale[:together], turn[:together] = np.log(1.2), 0.0
        here, there = x + 1j * y.astype(np.complex128), to_x + 1j * to_y.astype(np.complex128)
        factor = np.exp(log_scale + 1j * turn.astype(np.complex128))
        error = np.abs(there[:, None] + factor[:, None] * (here[None] - here[:, None]) - there[None])
        agree = (error < TOLERANCE) & (np.abs(log_scale[:, None] - log_scale[None]) < SCALE_STEP)
        agree &= (np.abs(turn) < MOST_TURN)[:, None]
        expected = agree[agree.sum(axis=1).argmax()] if count else np.zeros(0, np.bool_)
        found = native.similarity(x, y, to_x, to_y, log_scale, turn, TOLERANCE, SCALE_STEP, MOST_TURN)
        assert found.astype(bool).tolist() == expected.tolist() and found.sum() >= together
    nowhere = native.similarity(*[np.ones(2, np.float32)] * 6, TOLERANCE, SCALE_STEP, MOST_TURN)
    assert nowhere.tolist() == [0, 0]  # every feature is turned too far


def test_the_kernels_refuse_what_does_not_fit() -> None:
    some = np.zeros((3, 128), np.uint8)
    assert native.mutual(some[:0], some).shape == (0, 4)
    for rows, columns in ((some, some[:1]), (some[:, :64], some)):
        with pytest.raises((ValueError, TypeError)):
            native.mutual(rows, columns)
    with pytest.raises(ValueError, match="one length"):
        native.similarity(*[np.zeros(4, np.float32)] * 5, np.zeros(3, np.float32), 1.0, 1.0, 1.0)


def features(seed: int, count: int = 120) -> LocalFeatures:
    rng = np.random.default_rng(seed)
    return LocalFeatures(
        rng.uniform((60, 60), (580, 420), (count, 2)).astype(np.float32),
        np.exp(rng.uniform(0.5, 3, count)).astype(np.float32),
        rng.uniform(0, 2 * np.pi, count).astype(np.float32),
        rng.integers(0, 120, (count, 128), dtype=np.uint8),
        WIDTH,
        HEIGHT,
    )


def moved(
    one: LocalFeatures, scale: float, turn: float, shift: tuple[float, float], keep: int, seed: int = 9
) -> LocalFeatures:
    """The first ``keep`` features where a similarity takes them, in another order, the others somewhere else."""
    rng = np.random.default_rng(seed)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = (scale * one.points @ spin.T + shift + rng.normal(0, 1.0, one.points.shape)).astype(np.float32)
    points[keep:] = rng.uniform((0, 0), (WIDTH, HEIGHT), (len(points) - keep, 2))
    noise = rng.integers(-6, 7, one.descriptors.shape)
    descriptors = np.clip(one.descriptors.astype(int) + noise, 0, 255).astype(np.uint8)
    order = rng.permutation(len(points))
    scales = (one.scales * scale * np.exp(rng.normal(0, 0.05, len(points)))).astype(np.float32)
    angles = ((one.angles + turn + rng.normal(0, 0.05, len(points))) % (2 * np.pi)).astype(np.float32)
    return LocalFeatures(points[order], scales[order], angles[order], descriptors[order], WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("scale", "turn", "shift"), [(1, 0, (0, 0)), (1, 0, (90, -30)), (1.4, 0.1, (-150, -60)), (0.6, -0.2, (50, 150))]
)
def test_counts_what_moved_together_and_measures_the_scale(
    scale: float, turn: float, shift: tuple[float, float]
) -> None:
    one = features(1)
    found = compare(one, moved(one, scale, turn, shift, keep=70))
    assert 100 <= found.matches <= 120
    assert 68 <= found.inliers <= 82  # some of the fifty that went elsewhere land near by chance
    assert found.log_scale == pytest.approx(np.log(scale), abs=0.04)


def test_warp_is_nothing_for_a_shift_and_grows_with_scale() -> None:
    one = features(2)
    warps = [compare(one, moved(one, scale, 0, (10, 5), 120)).warp for scale in (1.0, 1.15, 1.4)]
    assert warps[0] < 0.004 < 0.015 < warps[1] < warps[2] < 0.12
    supports = [compare(one, moved(one, scale, 0, (10, 5), 120)).support for scale in (1.0, 1.15, 1.4)]
    assert np.log(121) - 0.1 < supports[0] <= np.log(121)
    assert supports[0] > supports[1] > supports[2] > 2


def test_chance_matches_do_not_agree() -> None:
    one = features(3)
    scattered = compare(one, moved(one, 1, 0, (0, 0), keep=0))
    assert scattered.matches > 100 and scattered.inliers < 12
    assert compare(one, features(4)).inliers < 8


def test_a_picture_on_its_side_is_not_the_place() -> None:
    one = features(5)
    spun = compare(one, moved(one, 1, np.pi / 2, (560, -80), 120))
    assert spun.matches > 100 and spun.inliers < 12


def test_support_is_never_negative_nor_beyond_the_inliers() -> None:
    for seed in range(30):
        one = features(seed, 15)
        found = compare(one, moved(one, 2.5, 0.4, (-300, -200), keep=seed % 12, seed=seed))
        assert 0 <= found.support <= np.log1p(found.inliers)


def test_nothing_to_compare() -> None:
    for count in (0, 1):
        assert compare(features(1, count), features(2)).inliers == 0
        assert compare(features(1), features(2, count)).matches == 0


def test_key_points_at_one_pixel_count_once() -> None:
    one = features(6, 40)
    doubled = LocalFeatures(
        np.concatenate([one.points, one.points]),
        np.concatenate([one.scales, one.scales]),
        np.concatenate([one.angles, one.angles + 1]),
        np.concatenate([one.descriptors, features(7, 40).descriptors]),
        WIDTH,
        HEIGHT,
    )
    assert compare(doubled, moved(doubled, 1, 0, (0, 0), 80)).inliers <= 40


def test_refuses_what_does_not_fit_together() -> None:
    one = features(8)
    broken = LocalFeatures(one.points[:-1], one.scales, one.angles, one.descriptors, WIDTH, HEIGHT)
    with pytest.raises(ObservationError, match="one length"):
        compare(one, broken)
