"""The vocabulary that ships: what it promises, and that it serves photographs it has never seen."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import seamark.vocab
from seamark.frontend.features import extract_features, thumbnail_of
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

PHOTOGRAPHS = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "gardens_point"


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return Vocabulary.default()


def test_the_default_is_what_was_promised(vocabulary: Vocabulary) -> None:
    assert vocabulary.words.shape == (65536, 128) and vocabulary.words.dtype == np.uint8
    assert vocabulary.idf.shape == (65536,)
    assert vocabulary.cells is not None and len(vocabulary.cells.centres) == 256
    assert 0 < vocabulary.idf.min() < vocabulary.idf.max() <= np.log(vocabulary.provenance["n_images"]) + 1e-6
    assert len(np.unique(vocabulary.words, axis=0)) > 64000
    assert vocabulary.provenance["images"].startswith("seamark.datasets_synth.imagery")
    size = (Path(seamark.vocab.__file__).parent / "default.vocab").stat().st_size
    assert 65536 * 132 < size <= 10_000_000


def test_its_words_lie_where_root_sift_lies(vocabulary: Vocabulary) -> None:
    """A RootSIFT descriptor has the length 512; the mean of a cluster is somewhat shorter."""
    length = np.linalg.norm(vocabulary.words.astype(np.float64), axis=1)
    assert np.percentile(length, 1) > 350 and length.max() < 520


def test_hardly_a_word_is_there_twice(vocabulary: Vocabulary) -> None:
    """Each word is its own nearest word, but for the few that appear twice."""
    assigned = vocabulary.assign(np.asarray(vocabulary.words))
    assert np.mean(assigned == np.arange(65536)) > 0.97


@pytest.mark.real_data
def test_photographs_of_one_place_find_each_other(vocabulary: Vocabulary) -> None:
    """Every tenth place of a walk, seen again from the other side of the path: 15 of 20 among the first three at least.

    Chance would find 3.
    """
    if not PHOTOGRAPHS.is_dir():
        pytest.skip(f"REAL DATA MISSING: {PHOTOGRAPHS} is not there, so the vocabulary was not tried on photographs")

    def observe(folder: str, number: int, session: int) -> PlaceObservation:
        image = cv2.imread(str(PHOTOGRAPHS / folder / f"Image{number:03d}.jpg"))
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        features = extract_features(image, 600)
        key = 1000 * session + number
        return PlaceObservation(key, session, number, features.descriptors, features.points, thumbnail_of(image, 96))

    index = PlaceIndex(vocabulary)
    places = range(0, 200, 10)
    for number in places:
        index.add(observe("day_left", number, 0))
    answers = {number: index.query(observe("day_right", number, 1), limit=3) for number in places}
    found = sum(number in [candidate.id for candidate in answer.ranked] for number, answer in answers.items())
    assert 15 <= found <= 20
