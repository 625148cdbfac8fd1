"""Recall of the place index on two traverses of one path: image i of one shows the place of image i of the other.

    .venv/bin/python benchmarks/places_retrieval.py [--vocab FILE] [--database DIR] [--queries DIR]

Prints recall@1/5/10 within +-3 images for the votes alone, the histograms alone and both. Images are taken singly: no
order, no geometry.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features, thumbnail_of
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "gardens_point"
CUTS = (1, 5, 10)


def observe(folder: Path, session: int) -> list[PlaceObservation]:
    settings = FrontendConfig()
    observations = []
    for index, path in enumerate(sorted(folder.glob("*.jpg"))):
        image = cv2.imread(str(path))
        features = extract_features(image, settings.sift_features, settings.sift_contrast)
        thumbnail = thumbnail_of(image, settings.thumbnail_px)
        key = 1_000_000 * session + index
        observations.append(PlaceObservation(key, session, index, features.descriptors, features.points, thumbnail))
    return observations


def recall(
    vocabulary: Vocabulary,
    database: Sequence[PlaceObservation],
    queries: Sequence[PlaceObservation],
    tolerance: int,
    **weights: float,
) -> tuple[list[float], float]:
    index = PlaceIndex(vocabulary, VocabConfig(**weights))
    for observation in database:
        index.add(observation)
    hits = np.zeros(len(CUTS))
    start = time.process_time()
    for number, observation in enumerate(queries):
        near = [abs(c.id - number) <= tolerance for c in index.query(observation, max(CUTS)).ranked]
        hits += [any(near[:cut]) for cut in CUTS]
    return list(hits / len(queries)), 1000 * (time.process_time() - start) / len(queries)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--database", type=Path, default=DATA / "day_left")
    parser.add_argument("--queries", type=Path, default=DATA / "day_right")
    parser.add_argument("--vocab", type=Path)
    parser.add_argument("--tolerance", type=int, default=3)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.load(options.vocab) if options.vocab else Vocabulary.default()
    database, queries = observe(options.database, 0), observe(options.queries, 1)
    default = VocabConfig()
    rows = {
        "votes": {"histogram_weight": 0.0},
        "histograms": {"votes_weight": 0.0, "histogram_weight": 1.0},
        f"both, 1 : {default.histogram_weight} (default)": {},
        "both, 1 : 0.05": {"histogram_weight": 0.05},
        "both, 1 : 0.3": {"histogram_weight": 0.3},
        "both, 1 : 1": {"histogram_weight": 1.0},
    }
    print(f"{vocabulary.n_words} words, {len(database)} places, {len(queries)} queries, +-{options.tolerance} images")
    print(f"{'':30}" + "".join(f"recall@{cut:<4}" for cut in CUTS) + "ms per query (words included)")
    for name, weights in rows.items():
        values, milliseconds = recall(vocabulary, database, queries, options.tolerance, **weights)
        print(f"{name:30}" + "".join(f"{value:<11.3f}" for value in values) + f"{milliseconds:.1f}")


if __name__ == "__main__":
    main()
