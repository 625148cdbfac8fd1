"""What each ingredient of place recognition is worth, on two traverses of one way: recall, and recall without an error.

    .venv/bin/python benchmarks/places.py DATABASE QUERIES [--tolerance 3] [--signatures]

DATABASE and QUERIES are folders of images; image i of one shows the place of image i of the other, so many images more
or less. Images are taken singly, but for the last row. Columns: recall@1, @5, @10, @20, recall at full
precision, and CPU time without looking for features, with what it takes to fill the index shared out.
``--signatures`` adds Hamming embedding and weak geometric consistency, with directions learned from generated images.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.imagery import training_images
from seamark.frontend.config import FrontendConfig
from seamark.service import places_metrics
from seamark.service.places_images import DescribedImage, available_workers, describe_files
from seamark.service.places_search import search
from seamark.service.sources.images import list_images
from seamark.vocab import signatures
from seamark.vocab.config import VocabConfig
from seamark.vocab.inverted_index import InvertedIndex
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.vocabulary import Vocabulary

CUES = {
    "votes": {"histogram_weight": 0.0, "view_weight": 0.0},
    "histograms": {"votes_weight": 0.0, "histogram_weight": 1.0, "view_weight": 0.0},
    "view": {"votes_weight": 0.0, "histogram_weight": 0.0, "view_weight": 1.0},
    "votes + histograms": {"view_weight": 0.0},
    "votes + view": {"histogram_weight": 0.0},
    "votes + histograms + view (default)": {},
}
Scores = NDArray[np.float64]
Images = Sequence[DescribedImage]


def by_cues(database: Images, queries: Images, vocabulary: Vocabulary, weights: dict[str, float]) -> Scores:
    index = PlaceIndex(vocabulary, VocabConfig(**weights))
    for number, image in enumerate(database):
        index.add(image.observation(number, 0))
    scores = np.zeros((len(queries), len(database)))
    for row, query in enumerate(queries):
        for candidate in index.query(query.observation(-1, 1), len(database)).ranked:
            scores[row, candidate.id] = candidate.score
    return scores


def by_signatures(database: Images, queries: Images, vocabulary: Vocabulary, *, with_geometry: bool) -> Scores:
    """The strongest features only, which are those whose scale and orientation are kept."""
    config = FrontendConfig()
    learned = np.concatenate([describe_features(image, config) for image in training_images(99, 60)])
    projection = signatures.learn_projection(learned, vocabulary.words, vocabulary.assign(learned))
    index = InvertedIndex(vocabulary.idf, with_signatures=True, with_geometry=with_geometry)

    def parts(image: DescribedImage) -> tuple[NDArray[np.int32], NDArray[np.uint64], NDArray[np.uint16] | None]:
        found = image.features
        words = vocabulary.assign(found.descriptors)
        signed = signatures.sign(found.descriptors, vocabulary.words, words, projection)
        return words, signed, signatures.geometry(found.angles, found.scales) if with_geometry else None

    for image in database:
        index.add(*parts(image))
    table = signatures.vote_table()
    rows = []
    for query in queries:
        words, signed, geometry = parts(query)
        rows.append(index.near_votes(words, signed, table, geometry))
    return np.stack(rows).astype(np.float64)


def describe_features(image: NDArray[np.uint8], config: FrontendConfig) -> NDArray[np.uint8]:
    from seamark.frontend.features import extract_features

    return extract_features(
        image, config.sift_features, config.sift_contrast, max_pixels=config.sift_pixels
    ).descriptors


def report(name: str, ranked: Sequence[Sequence[int]], best: Scores, truth: NDArray[np.bool_], ms: float) -> None:
    recalls = [places_metrics.recall_at(ranked, truth, n) for n in places_metrics.RECALL_AT]
    right = np.array([truth[row, places[0]] for row, places in enumerate(ranked)])
    full = places_metrics.recall_at_full_precision(places_metrics.curve(best, right, len(truth)))
    print(f"| {name} | " + " | ".join(f"{value:.3f}" for value in (*recalls, full)) + f" | {ms:.1f} |", flush=True)


def timed(work: Callable[[], Scores], queries: int) -> tuple[Scores, float]:
    start = time.process_time()
    scores = work()
    return scores, 1e3 * (time.process_time() - start) / queries


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("database", type=Path)
    parser.add_argument("queries", type=Path)
    parser.add_argument("--tolerance", type=int, default=3)
    parser.add_argument("--vocab", type=Path)
    parser.add_argument("--signatures", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.load(options.vocab) if options.vocab else Vocabulary.default()
    config, workers = FrontendConfig(), available_workers()
    database, queries = (
        describe_files(list_images(folder), config, workers) for folder in (options.database, options.queries)
    )
    truth = np.abs(np.arange(len(queries))[:, None] - np.arange(len(database))[None]) <= options.tolerance
    print(f"{vocabulary.n_words} words, {len(database)} places, {len(queries)} queries, +-{options.tolerance} images\n")
    print("| | @1 | @5 | @10 | @20 | full precision | CPU ms per query |\n|---|---|---|---|---|---|---|")

    def ranked(scores: Scores) -> list[list[int]]:
        return [np.argsort(-row, kind="stable")[: max(places_metrics.RECALL_AT)].tolist() for row in scores]

    for name, weights in CUES.items():
        scores, ms = timed(lambda weights=weights: by_cues(database, queries, vocabulary, weights), len(queries))
        report(name, ranked(scores), scores.max(axis=1), truth, ms)
    for with_geometry in (False, True) if options.signatures else ():
        scores, ms = timed(
            lambda geometry=with_geometry: by_signatures(database, queries, vocabulary, with_geometry=geometry),
            len(queries),
        )
        name = "votes with signatures" + (", orientation and scale" if with_geometry else "")
        report(name, ranked(scores), scores.max(axis=1), truth, ms)
    for name, in_order in (("default + verification of 20", False), ("default in order (--sequence)", True)):
        start = time.process_time()
        answers = search(database, queries, vocabulary, VocabConfig(), top=20, in_order=in_order, workers=1)
        ms = 1e3 * (time.process_time() - start) / len(queries)
        places = [[match.place for match in answer.matches] for answer in answers]
        if not in_order:
            evidence = np.array([answer.evidence for answer in answers])
            report(name, places, evidence, truth, ms)
            name += ", less doubt (places match)"
        report(name, places, np.array([answer.matches[0].score for answer in answers]), truth, ms)


if __name__ == "__main__":
    main()
