"""Spatial evidence on features whose true motion is known."""

import numpy as np
import pytest

from seamark.vocab.errors import ObservationError
from seamark.vocab.spatial import LocalFeatures, compare

WIDTH, HEIGHT = 640, 480


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
