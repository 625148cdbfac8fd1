"""What each ingredient of place recognition is worth: recall, and recall without an error.

    .venv/bin/python benchmarks/places.py DATABASE QUERIES [--tolerance 3] [--every 1]
    .venv/bin/python benchmarks/places.py SOURCE [--every 1]

Sources are those of ``seamark places eval``, and so is the truth: poses where both have them, else the number of the
image. A single source is asked for its own past, with the front end's odometry in rows of their own. Only every
``--every``-th image is used. Images are taken singly, but for rows in order. Columns: recall@1, @5, @10, @20, recall
at full precision, and CPU time without looking for features, with what it takes to fill the index shared out. Then
the probability of the default against how many answers were right.
Signatures are Hamming embedding, geometry weak geometric consistency, islands neighbouring places taken together.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from itertools import islice, pairwise, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.service import places_metrics
from seamark.service.places_eval import EvalOptions, same_places
from seamark.service.places_images import DescribedImage, available_workers, describe_frames
from seamark.service.places_motion import Motion, follow
from seamark.service.places_search import Answer, search, search_own
from seamark.service.sources.base import Source
from seamark.service.sources.open import open_sources
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.vocabulary import Vocabulary

CUES = {
    "votes": {"histogram_weight": 0.0, "view_weight": 0.0},
    "histograms": {"votes_weight": 0.0, "histogram_weight": 1.0, "view_weight": 0.0},
    "view": {"votes_weight": 0.0, "histogram_weight": 0.0, "view_weight": 1.0},
    "votes, 2 nearest words": {"histogram_weight": 0.0, "view_weight": 0.0, "soft_words": 2},
    "votes, 3 nearest words": {"histogram_weight": 0.0, "view_weight": 0.0, "soft_words": 3},
    "votes, signatures": {"histogram_weight": 0.0, "view_weight": 0.0, "signatures": True},
    "votes, signatures, geometry": {"histogram_weight": 0.0, "view_weight": 0.0, "signatures": True, "geometry": True},
    "votes + histograms": {"view_weight": 0.0},
    "votes + view": {"histogram_weight": 0.0},
    "votes + histograms + view (default)": {},
    "default, signatures": {"signatures": True},
    "default, signatures, geometry": {"signatures": True, "geometry": True},
}
Scores = NDArray[np.float64]
Images = Sequence[DescribedImage]


def by_cues(database: Images, queries: Images, vocabulary: Vocabulary, weights: dict[str, Any]) -> Scores:
    index = PlaceIndex(vocabulary, VocabConfig(**weights))
    for number, image in enumerate(database):
        index.add(image.observation(number, 0))
    scores = np.zeros((len(queries), len(database)))
    for row, query in enumerate(queries):
        for candidate in index.query(query.observation(-1, 1), len(database)).ranked:
            scores[row, candidate.id] = candidate.score
    return scores


def by_islands(scores: Scores) -> Scores:
    """Return scores in which each place counts by half with the mean of itself and both neighbours in the database."""
    padded = np.pad(scores, ((0, 0), (1, 1)), mode="edge")
    return (scores + (padded[:, :-2] + scores + padded[:, 2:]) / 3) / 2


def report(name: str, ranked: Sequence[Sequence[int]], best: Scores, truth: NDArray[np.bool_], ms: float) -> None:
    recalls = [places_metrics.recall_at(ranked, truth, n) for n in places_metrics.RECALL_AT]
    right = np.array([truth[row, places[0]] for row, places in enumerate(ranked)])
    full = places_metrics.recall_at_full_precision(places_metrics.curve(best, right, int(truth.any(axis=1).sum())))
    print(f"| {name} | " + " | ".join(f"{value:.3f}" for value in (*recalls, full)) + f" | {ms:.1f} |", flush=True)


def timed(work: Callable[[], Scores], queries: int) -> tuple[Scores, float]:
    start = time.process_time()
    scores = work()
    return scores, 1e3 * (time.process_time() - start) / queries


def reliability(answers: Sequence[Answer], truth: NDArray[np.bool_]) -> None:
    print("\n| probability | answers | mean | right |\n|---|---|---|---|")
    said = np.array([answer.probability for answer in answers])
    right = np.array([bool(a.matches) and truth[row, a.matches[0].place] for row, a in enumerate(answers)], np.float64)
    for low, high in pairwise((0.0, 0.5, 0.8, 0.95, 0.99, 1.0 + 1e-9)):
        inside = (said >= low) & (said < high)
        if inside.any():
            mean, found = said[inside].mean(), right[inside].mean()
            print(f"| {low:g} to {min(high, 1.0):g} | {inside.sum()} | {mean:.2f} | {found:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("database")
    parser.add_argument("queries", nargs="?")
    parser.add_argument("--tolerance", type=int, default=3)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--vocab", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.load(options.vocab) if options.vocab else Vocabulary.default()
    config, workers, own = FrontendConfig(), available_workers(), options.queries is None
    first = open_sources([options.database], mode=None if own else "places")
    second = first if own else open_sources([options.queries], mode="places")
    asked = EvalOptions(Path(), tolerance_images=options.tolerance)
    truth, judged, said = same_places(first, second, asked, own=own)

    def described(source: Source) -> list[DescribedImage]:
        chosen = islice(source.frames(), 0, None, options.every)
        return describe_frames(chosen, source.n_frames, config, workers)

    database = described(first)
    queries = database if own else described(second)
    truth, judged = truth[:: options.every, :: options.every], judged[:: options.every]
    eligible, motion, stamps = np.ones(truth.shape, np.bool_), None, []
    if own:
        assert first.stamps_ns is not None
        stamps = first.stamps_ns[:: options.every].tolist()
        settings = VocabConfig()
        if first.period_ns >= 10**9:
            settings = VocabConfig(exclude_recent_s=0.0, exclude_recent_count=settings.exclude_recent_count_places)
        followed = follow(first, config)
        if followed is not None:
            motion = Motion(followed.T_odom_cam[:: options.every], followed.sessions[:: options.every], followed.metric)
        arguments: dict[str, Any] = {"top": 20, "in_order": False, "workers": 1}
        _, eligible = search_own(database, stamps, vocabulary, settings, **arguments)
    truth = truth & eligible
    rows = np.flatnonzero(judged & eligible.any(axis=1))
    print(f"{len(database)} places, {len(rows)} queries, {int(truth[rows].any(axis=1).sum())} with a place; {said}\n")
    print("| | @1 | @5 | @10 | @20 | full precision | CPU ms per query |\n|---|---|---|---|---|---|---|")

    def matrix(name: str, work: Callable[[], Scores]) -> None:
        scores, ms = timed(work, len(queries))
        scores = np.where(eligible, scores, -np.inf)[rows]
        ranked = [np.argsort(-row, kind="stable")[: max(places_metrics.RECALL_AT)].tolist() for row in scores]
        report(name, ranked, scores.max(axis=1), truth[rows], ms)

    for name, weights in CUES.items():
        matrix(name, lambda weights=weights: by_cues(database, queries, vocabulary, weights))
    for name in ("votes", "votes + histograms + view (default)"):
        weights = CUES[name]
        matrix(f"{name}, islands", lambda weights=weights: by_islands(by_cues(database, queries, vocabulary, weights)))
    for by, in_order, together in product((None, motion) if motion else (None,), (False, True), (False, True)):
        if own and together:
            continue
        start = time.process_time()
        arguments = {"top": 20, "in_order": in_order, "workers": 1}
        if own:
            answers, _ = search_own(database, stamps, vocabulary, settings, **arguments, motion=by)
        else:
            answers = search(database, queries, vocabulary, VocabConfig(), **arguments, together=together)
        ms = 1e3 * (time.process_time() - start) / len(queries)
        answers = [answers[row] for row in rows]
        places = [[match.place for match in answer.matches] for answer in answers]
        name = (
            ("in order" if in_order else "verification of 20")
            + (", odometry" if by else "")
            + (", together" if together else "")
        )
        if not in_order and not by:
            report(name, places, np.array([answer.evidence for answer in answers]), truth[rows], ms)
            name += ", less doubt (places match)"
        report(name, places, np.array([answer.matches[0].score for answer in answers]), truth[rows], ms)
        if not in_order and by is motion and not together:
            singly = answers
        right = [truth[row, a.matches[0].place] for row, a in zip(rows, answers, strict=True) if a.matches[0].accepted]
        print(f"| accepted | {sum(right)} right, {len(right) - sum(right)} wrong |")
    reliability(singly, truth[rows])


if __name__ == "__main__":
    main()
