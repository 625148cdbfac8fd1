"""Figures of `seamark places eval`, against counts by hand, an independent binomial, and rendered or toy truth."""

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.frontend.types import Frame
from seamark.service import places_metrics
from seamark.service.config import SeamarkConfig
from seamark.service.evaluation import EvaluationError
from seamark.service.places_eval import EvalOptions, evaluate_places, report_table
from seamark.service.sources.base import Source
from seamark.service.sources.open import open_sources

CONFIG = SeamarkConfig()


def every_eighth(source: Source) -> Source:
    """The sequence at an eighth of its rate."""
    kept = [frame for frame in source.frames() if isinstance(frame, Frame)][::8]

    class Thinned:
        name, mode, modes, rig, ground_truth = source.name, source.mode, source.modes, source.rig, source.ground_truth
        n_frames = len(kept)
        stamps_ns = np.array([frame.stamp_ns for frame in kept], np.int64)
        period_ns = 8 * source.period_ns

        def frames(self) -> Iterator[Frame]:
            return iter(kept)

    return Thinned()  # type: ignore[return-value]


def test_recall_at_n_asks_only_queries_that_have_a_place() -> None:
    true_places = np.zeros((4, 6), np.bool_)
    true_places[0, 2] = true_places[1, 5] = true_places[1, 4] = true_places[2, 0] = True
    ranked = [[2, 1, 0], [1, 4, 5], [1, 2, 3], [0, 1, 2]]
    assert places_metrics.recall_at(ranked, true_places, 1) == pytest.approx(1 / 3)
    assert places_metrics.recall_at(ranked, true_places, 2) == pytest.approx(2 / 3)
    assert places_metrics.recall_at(ranked, true_places, 20) == pytest.approx(2 / 3)
    assert math.isnan(places_metrics.recall_at(ranked, np.zeros((4, 6), np.bool_), 1))


def test_the_curve_counts_right_answers_from_the_surest_on() -> None:
    scores = np.array([0.9, 0.8, 0.8, 0.7, 0.6])
    right = np.array([True, True, False, True, False])
    found = places_metrics.curve(scores, right, 4)
    assert found.threshold.tolist() == [0.9, 0.8, 0.7, 0.6]  # equal scores are answered together or not at all
    assert found.answered.tolist() == [1, 3, 4, 5]
    assert found.right.tolist() == [1, 2, 3, 3]
    assert found.precision == pytest.approx([1, 2 / 3, 3 / 4, 3 / 5])
    assert found.recall == pytest.approx([1 / 4, 2 / 4, 3 / 4, 3 / 4])
    assert places_metrics.recall_at_full_precision(found) == 0.25
    nothing = places_metrics.curve(np.zeros(0), np.zeros(0, np.bool_), 0)
    assert places_metrics.recall_at_full_precision(nothing) == 0
    assert places_metrics.choose_threshold(nothing, 0.9).value is None


@pytest.mark.parametrize(("successes", "trials"), [(1, 1), (10, 10), (59, 59), (95, 100), (3, 50), (199, 200)])
def test_the_bound_is_where_the_binomial_says(successes: int, trials: int) -> None:
    bound = places_metrics.lower_bound(successes, trials)
    assert 0 < bound < successes / trials
    tail = sum(math.comb(trials, k) * bound**k * (1 - bound) ** (trials - k) for k in range(successes, trials + 1))
    assert tail == pytest.approx(0.05, rel=1e-6)
    assert places_metrics.lower_bound(trials, trials) == pytest.approx(0.05 ** (1 / trials), abs=1e-9)
    assert places_metrics.lower_bound(0, trials) == 0


def test_the_threshold_keeps_its_promise_and_no_better_one_is_left_out() -> None:
    scores = np.linspace(1, 0, 300)
    right = np.ones(300, np.bool_)
    right[[150, 200, 210, 220, 230, *range(240, 300, 2)]] = False
    found = places_metrics.curve(scores, right, 300)
    chosen = places_metrics.choose_threshold(found, 0.95)
    assert chosen.value is not None and chosen.precision_bound >= 0.95
    answered = scores >= chosen.value
    assert chosen.answered == answered.sum() and chosen.precision == pytest.approx(right[answered].mean())
    for more in range(chosen.answered + 1, 301):
        assert (
            places_metrics.lower_bound(int(right[:more].sum()), more) < 0.95
            or right[:more].sum() == right[answered].sum()
        )
    assert places_metrics.choose_threshold(found, 0.9999).value is None


def test_a_second_traversal_without_poses_is_judged_by_number(tmp_path: Path) -> None:
    for name, offset in (("first", 0), ("second", 6)):
        (tmp_path / name).mkdir()
        for place in range(6):
            rng = np.random.default_rng(place)
            canvas = np.full((240, 330, 3), rng.integers(60, 200, 3), np.uint8)
            for _ in range(40):
                x, y, w, h = (int(v) for v in rng.integers((0, 0, 6, 6), (300, 220, 70, 70)))
                cv2.rectangle(canvas, (x, y), (x + w, y + h), rng.integers(0, 256, 3).tolist(), -1)
            cv2.imwrite(str(tmp_path / name / f"{place}.png"), canvas[:, offset : offset + 320])
    sources = [open_sources([str(tmp_path / name)], mode="places") for name in ("first", "second")]
    out = tmp_path / "out"
    report = evaluate_places(*sources, EvalOptions(out, tolerance_images=0), CONFIG, 2, pytest.fail)  # type: ignore[arg-type]
    assert sorted(path.name for path in out.iterdir()) == [
        "matches.csv",
        "places_eval.json",
        "places_eval.png",
        "precision_recall.csv",
    ]
    assert json.loads((out / "places_eval.json").read_text()) == report
    assert report["truth"] == "images of the same number, 0 more or less"
    assert report["recall_at"] == {"1": 1.0, "5": 1.0, "10": 1.0, "20": 1.0}
    assert report["recall_at_full_precision"] == 1.0
    assert report["threshold"]["score"] is None and report["threshold"]["precision_bound"] == pytest.approx(
        0.05 ** (1 / 6)
    )
    assert report["accepted"]["wrong"] == 0
    with (out / "matches.csv").open(newline="") as stream:
        assert len(list(csv.DictReader(stream))) == 36
    with (out / "precision_recall.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["threshold", "answered", "right", "precision", "recall"]
    assert rows[-1]["answered"] == "6" and float(rows[-1]["recall"]) == 1
    assert cv2.imread(str(out / "places_eval.png")).shape[0] > 300
    assert report_table(report).row_count >= 10


def test_a_loop_is_judged_by_poses_and_the_recent_past_is_not_asked(tmp_path: Path) -> None:
    source = every_eighth(open_sources(["synth:small_loop"], mode="places"))
    report = evaluate_places(
        source, None, EvalOptions(tmp_path, distance_m=2.0, angle_deg=60.0), CONFIG, 2, pytest.fail
    )
    assert report["queries"] == source.n_frames and report["against"] is None
    assert 0 < report["queries_with_a_true_place"] < source.n_frames / 2
    assert 0.6 <= report["recall_at"]["1"] <= report["recall_at"]["20"] <= 1
    assert report["accepted"]["wrong"] == 0
    with (tmp_path / "matches.csv").open(newline="") as stream:
        first = {row["query"]: row["match"] for row in csv.DictReader(stream) if row["rank"] == "1"}
    assert len(first) < source.n_frames  # the first images have no past


def test_says_what_is_missing(tmp_path: Path) -> None:
    for name, count in (("two", 2), ("three", 3)):
        (tmp_path / name).mkdir()
        for number in range(count):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.zeros((8, 8), np.uint8))
    two, three = (open_sources([str(tmp_path / name)], mode="places") for name in ("two", "three"))
    with pytest.raises(EvaluationError, match="two has no ground truth"):
        evaluate_places(two, None, EvalOptions(tmp_path / "out"), CONFIG, 1, pytest.fail)
    with pytest.raises(EvaluationError, match="2 and 3 images"):
        evaluate_places(two, three, EvalOptions(tmp_path / "out"), CONFIG, 1, pytest.fail)
    assert not (tmp_path / "out").exists()
