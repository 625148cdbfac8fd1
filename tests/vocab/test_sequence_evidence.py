"""Evidence along ways, against every way counted one by one, and on noise that hides single images."""

import itertools

import numpy as np
import pytest

from seamark.vocab import confidence
from seamark.vocab.sequence import MEMORY, UNEVEN_STEP, along_ways, reach, streaks


def test_equals_the_best_of_all_ways_counted_one_by_one() -> None:
    rng = np.random.default_rng(0)
    scores = rng.uniform(0, 1, (4, 9))
    unit = np.clip((scores - scores.mean(axis=1, keepdims=True)) / scores.std(axis=1, keepdims=True), -1, 5)
    found = along_ways(scores)
    for query, place in itertools.product(
        range(4), range(3, 6)
    ):  # places that no way of this length leaves the row from
        best = -np.inf
        for direction in (1, -1):
            total = unit[query, place]
            for sense, length in ((-1, query), (1, 3 - query)):
                totals = []
                for steps in itertools.product((0, 1, 2), repeat=length):
                    positions = place + sense * direction * np.cumsum(steps)
                    if length and (positions.min() < 0 or positions.max() > 8):
                        continue
                    gain, fade = 0.0, 1.0
                    for k, (step, position) in enumerate(zip(steps, positions, strict=True), 1):
                        fade *= MEMORY
                        gain += fade * (unit[query + sense * k, position] - (0.0 if step == 1 else UNEVEN_STEP))
                    totals.append(gain)
                total += max(totals)
            best = max(best, total)
        assert found[query, place] == pytest.approx(best, abs=1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_order_finds_what_noise_hides(direction: int) -> None:
    rng = np.random.default_rng(1)
    scores = rng.normal(0, 1, (150, 200))
    truth = np.round(np.linspace(20, 170, 150)).astype(int)[::direction]
    scores[np.arange(150), truth] += 1.5
    alone = np.abs(scores.argmax(axis=1) - truth) <= 2
    together = np.abs(along_ways(scores).argmax(axis=1) - truth) <= 2
    assert 0.05 < alone.mean() < 0.4
    assert 0.97 < together.mean() <= 1


def test_no_unit_and_no_offset_matters() -> None:
    scores = np.random.default_rng(2).uniform(0, 1, (12, 15))
    assert along_ways(scores) == pytest.approx(along_ways(7 * scores + np.arange(12)[:, None]), abs=1e-9)


def test_small_and_flat_tables() -> None:
    assert along_ways(np.zeros((0, 5))).shape == (0, 5)
    assert (along_ways(np.full((3, 1), 0.5)) <= 0).all()
    assert np.isfinite(along_ways(np.full((5, 4), 0.2))).all()
    assert reach(3) == pytest.approx([1 + MEMORY + MEMORY**2, 1 + 2 * MEMORY, 1 + MEMORY + MEMORY**2])


@pytest.mark.parametrize("calibration", [confidence.AS_THEY_ARE, confidence.TRAVERSALS])
def test_probabilities_grow_with_evidence_and_are_sure_of_little(calibration: confidence.Calibration) -> None:
    grid = [
        [calibration.probability_single(score, inliers) for score in (0.15, 0.3, 0.6)] for inliers in (0, 8, 30, 200)
    ]
    assert (np.diff(grid, axis=0) > 0).all() and (np.diff(grid, axis=1) > 0).all()
    assert grid[0][0] < 0.01 and grid[-1][-1] > 0.99
    along = [calibration.probability_along_way(value) for value in (-1, 0, 1, 3, 5)]
    assert (np.diff(along) > 0).all() and along[1] < 0.05 and along[-1] > 0.95


@pytest.mark.parametrize("calibration", [confidence.AS_THEY_ARE, confidence.TRAVERSALS])
def test_doubt_grows_with_the_number_of_equals(calibration: confidence.Calibration) -> None:
    assert calibration.doubt([]) == 0 and calibration.doubt([0.4]) == 0
    assert calibration.doubt([0.4, 0.4]) == pytest.approx(0.4 * np.log(2))
    assert 0 < calibration.doubt([0.4, 0.3]) < 0.05
    assert calibration.doubt([0.5] * 20) == pytest.approx(0.4 * np.log(20))


def test_a_streak_lasts_while_neighbours_are_found() -> None:
    found = np.array([-1, 5, 6, 9, 14, 13, -1, 13, 12, 8, 8])
    assert streaks(found, 4).tolist() == [0, 1, 2, 3, 1, 2, 0, 1, 2, 3, 4]
    assert streaks(found, 0).tolist() == [0, 1, 1, 1, 1, 1, 0, 1, 1, 1, 2]
    assert streaks(np.zeros(0, np.int64), 3).tolist() == []
