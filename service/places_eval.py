"""`seamark places eval`: how well places are recognised on one's own images, and from which score on to believe it."""

import csv
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from seamark.service import places_metrics
from seamark.service.config import SeamarkConfig
from seamark.service.evaluation import MAX_DIFFERENCE_S, EvaluationError, associate
from seamark.service.output import prepare_output
from seamark.service.places_images import DescribedImage, Progress, describe_frames
from seamark.service.places_match import matches_table, warn_of_unreadable, write_table
from seamark.service.places_metrics import RECALL_AT, Curve
from seamark.service.places_motion import follow
from seamark.service.places_picture import draw_evaluation
from seamark.service.places_search import Answer, search, search_own
from seamark.service.sources.base import Source
from seamark.service.stamps import NANOSECONDS
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary

CURVE_COLUMNS = ("threshold", "answered", "right", "precision", "recall")


@dataclass(frozen=True)
class EvalOptions:
    """What was asked for.

    Images show the same place when their true poses are within ``distance_m`` and ``angle_deg``; where poses are
    unknown, image i of one traversal shows the place of image i of the other, ``tolerance_images`` more or less. With
    ``together`` or ``in_order`` the images of a second traversal are compared without what all have in common.
    """

    out: Path
    in_order: bool = False
    vocabulary: Path | None = None
    distance_m: float = 3.0
    angle_deg: float = 45.0
    tolerance_images: int = 3
    precision: float = 0.95
    together: bool = False


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The answers of all queries with the truth: ``true_places`` and ``eligible`` (queries, places) bool.

    ``judged`` (queries,) says for which the truth is known.
    """

    answers: Sequence[Answer]
    true_places: NDArray[np.bool_]
    judged: NDArray[np.bool_]
    truth: str

    def curve(self) -> Curve:
        """Return precision against recall of the first places, by their score."""
        rows = np.flatnonzero(self.judged).tolist()
        asked = [row for row in rows if self.answers[row].matches]
        scores = np.array([self.answers[row].matches[0].score for row in asked], np.float64)
        right = np.array([self.true_places[row, self.answers[row].matches[0].place] for row in asked], np.bool_)
        return places_metrics.curve(scores, right, int(self.true_places[rows].any(axis=1).sum()))


def evaluate_places(
    source: Source,
    against: Source | None,
    options: EvalOptions,
    config: SeamarkConfig,
    workers: int,
    warn: Callable[[str], None],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Recognise the places of ``source`` in its own past, or those of ``against`` in ``source``, and judge it.

    In its own past places must agree with odometry too, where the source is calibrated and of a mode that has any.
    Writes matches.csv, precision_recall.csv, places_eval.json and places_eval.png into ``options.out`` and returns what
    the JSON holds. Raises EvaluationError where nothing tells which images show the same place.
    """
    truth = same_places(source, source if against is None else against, options, own=against is None)
    vocabulary = Vocabulary.default() if options.vocabulary is None else Vocabulary.load(options.vocabulary)
    with prepare_output(options.out) as output:
        database = _describe(source, config, workers, warn, progress)
        queries = database if against is None else _describe(against, config, workers, warn, progress)
        top = max(RECALL_AT)
        arguments: dict[str, Any] = {"top": top, "in_order": options.in_order, "workers": workers}
        same, judged, said = truth
        motion = None
        if against is None:
            settings = _own_settings(config.vocab, source)
            stamps = source.stamps_ns
            assert stamps is not None  # the truth was found by them
            motion = follow(source, config.frontend)
            answers, eligible = search_own(database, stamps.tolist(), vocabulary, settings, **arguments, motion=motion)
            same = same & eligible
        else:
            answers = search(
                database, queries, vocabulary, config.vocab, **arguments, together=options.together or options.in_order
            )
        evaluation = Evaluation(answers, same, judged, said)
        report = build_report(evaluation, options)
        report |= {"source": source.name, "against": against.name if against else None, "words": vocabulary.n_words}
        report["odometry"] = motion is not None
        write_table(output.staging / "matches.csv", matches_table(database, queries, answers))
        _write_curve(output.staging / "precision_recall.csv", evaluation.curve())
        (output.staging / "places_eval.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        draw_evaluation(evaluation.curve(), report, output.staging / "places_eval.png")
        output.commit()
    return report


def build_report(evaluation: Evaluation, options: EvalOptions) -> dict[str, Any]:
    """Return what is known of the answers as plain values; None stands for what could not be measured."""
    rows = np.flatnonzero(evaluation.judged).tolist()
    ranked = [[match.place for match in evaluation.answers[row].matches] for row in rows]
    true_places = evaluation.true_places[rows]
    found = evaluation.curve()
    chosen = places_metrics.choose_threshold(found, options.precision)
    accepted = [row for row in rows if evaluation.answers[row].matches and evaluation.answers[row].matches[0].accepted]
    right = sum(bool(evaluation.true_places[row, evaluation.answers[row].matches[0].place]) for row in accepted)
    matchable = int(true_places.any(axis=1).sum())
    return {
        "truth": evaluation.truth,
        "in_order": options.in_order,
        "places": evaluation.true_places.shape[1],
        "queries": len(rows),
        "queries_with_a_true_place": matchable,
        "recall_at": {str(n): _known(places_metrics.recall_at(ranked, true_places, n)) for n in RECALL_AT},
        "recall_at_full_precision": places_metrics.recall_at_full_precision(found),
        "threshold": {
            "score": chosen.value,
            "precision": _known(chosen.precision),
            "precision_bound": chosen.precision_bound,
            "bound_confidence": places_metrics.CONFIDENCE,
            "recall": chosen.recall,
            "answered": chosen.answered,
        },
        "accepted": {
            "right": right,
            "wrong": len(accepted) - right,
            "recall": right / matchable if matchable else None,
        },
        "verdicts": dict(sorted(Counter(str(evaluation.answers[row].verdict) for row in rows).items())),
    }


def report_table(report: dict[str, Any]) -> Table:
    """Return the report for people."""
    table = Table(show_header=False, box=None)
    table.add_row("truth", report["truth"])
    table.add_row("odometry", "asked" if report.get("odometry") else "not asked")
    table.add_row("places, queries", f"{report['places']}, {report['queries']}")
    table.add_row("with a true place", str(report["queries_with_a_true_place"]))
    for n, value in report["recall_at"].items():
        table.add_row(f"recall@{n}", "-" if value is None else f"{value:.3f}")
    table.add_row("recall at full precision", f"{report['recall_at_full_precision']:.3f}")
    threshold, accepted = report["threshold"], report["accepted"]
    if threshold["score"] is None:
        table.add_row("threshold", "none reaches the precision that was asked for")
    else:
        bound = f"precision at least {threshold['precision_bound']:.3f}, recall {threshold['recall']:.3f}"
        table.add_row("threshold", f"score {threshold['score']:.3f}: {bound}")
    table.add_row("accepted by default", f"{accepted['right']} right, {accepted['wrong']} wrong")
    return table


def same_places(
    source: Source, queries: Source, options: EvalOptions, *, own: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], str]:
    """Return which places each query shows (queries, places), for which queries that is known, and by what."""
    poses = [_poses(one) for one in (source, queries)]
    if poses[0] is not None and poses[1] is not None:
        (T_place, known_place), (T_query, known_query) = poses[0], poses[1]
        distance = np.linalg.norm(T_query[:, None, :3, 3] - T_place[None, :, :3, 3], axis=2)
        trace = np.einsum("aij,bij->ab", T_query[:, :3, :3], T_place[:, :3, :3])
        angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
        same = (distance <= options.distance_m) & (angle <= options.angle_deg)
        same &= known_query[:, None] & known_place[None]
        return same, known_query, f"poses within {options.distance_m:g} m and {options.angle_deg:g} degrees"
    if own:
        raise EvaluationError(f"{source.name} has no ground truth, so nothing tells which of its images show one place")
    if source.n_frames is None or source.n_frames != queries.n_frames:
        counts = f"{source.n_frames} and {queries.n_frames} images"
        raise EvaluationError(
            f"{source.name} and {queries.name} have no ground truth and not the same number of images ({counts}), "
            "so nothing tells which of them show one place"
        )
    index = np.arange(source.n_frames)
    same = np.abs(index[:, None] - index[None]) <= options.tolerance_images
    known = np.ones(len(index), np.bool_)
    return same, known, f"images of the same number, {options.tolerance_images} more or less"


def _poses(source: Source) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Return T_world_cam of every frame and whether it is known, or None without ground truth."""
    truth, stamps = source.ground_truth, source.stamps_ns
    if truth is None or stamps is None or len(truth) == 0:
        return None
    poses, known = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps), np.bool_)
    i, j = associate(stamps, truth.stamps_ns, MAX_DIFFERENCE_S)
    poses[i], known[i] = truth.T_world_cam[j], True
    return poses, known


def _own_settings(config: VocabConfig, source: Source) -> VocabConfig:
    """Stamps of plain images tell no motion: there the recent past is counted in images."""
    if source.period_ns < NANOSECONDS:
        return config
    return config.model_copy(
        update={"exclude_recent_s": 0.0, "exclude_recent_count": config.exclude_recent_count_places}
    )


def _describe(
    source: Source, config: SeamarkConfig, workers: int, warn: Callable[[str], None], progress: Progress | None
) -> list[DescribedImage]:
    images = describe_frames(source.frames(), source.n_frames, config.frontend, workers, progress)
    warn_of_unreadable(source.name, images, warn)
    return images


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _write_curve(path: Path, found: Curve) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(CURVE_COLUMNS)
        for row in zip(found.threshold, found.answered, found.right, found.precision, found.recall, strict=True):
            threshold, answered, right, precision, recall = row
            writer.writerow((f"{threshold:.6f}", str(answered), str(right), f"{precision:.6f}", f"{recall:.6f}"))
