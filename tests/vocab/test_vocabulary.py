"""Words and their assignment, against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seamark.vocab.errors import ObservationError
from seamark.vocab.vocabulary import MIN_IDF, Vocabulary, inverse_document_frequency


def nearest_by_brute_force(words: np.ndarray, descriptors: np.ndarray) -> np.ndarray:
    difference = descriptors[:, None].astype(np.int64) - words[None].astype(np.int64)
    return (difference**2).sum(axis=2).argmin(axis=1)


def make(seed: int, n_words: int) -> Vocabulary:
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 256, (n_words, 128), dtype=np.uint8)
    return Vocabulary(words, rng.uniform(0.5, 5, n_words).astype(np.float32))


@given(seed=st.integers(0, 10_000), n_words=st.integers(1, 60), n=st.integers(0, 40))
@settings(max_examples=40, deadline=None)
def test_assign_is_the_nearest_word(seed: int, n_words: int, n: int) -> None:
    vocabulary = make(seed, n_words)
    descriptors = np.random.default_rng(seed + 1).integers(0, 256, (n, 128), dtype=np.uint8)
    assigned = vocabulary.assign(descriptors)
    assert assigned.dtype == np.int32 and assigned.shape == (n,)
    np.testing.assert_array_equal(assigned, nearest_by_brute_force(vocabulary.words, descriptors))


@pytest.mark.parametrize("batch", [1, 7, 19, 20, 21, 300])
def test_of_equally_near_words_the_lowest_wins_in_batches_of_any_size(batch: int) -> None:
    """Descriptors are compared four at a time; the answer must not depend on who is beside them."""
    words = make(3, 200).words.copy()
    words[100:] = words[:100]
    vocabulary = Vocabulary(words, np.ones(200, np.float32))
    rng = np.random.default_rng(4)
    noisy = np.clip(words[rng.integers(0, 200, 300)].astype(int) + rng.integers(-2, 3, (300, 128)), 0, 255)
    descriptors = noisy.astype(np.uint8)
    assigned = np.concatenate([vocabulary.assign(descriptors[i : i + batch]) for i in range(0, 300, batch)])
    assert assigned.max() < 100
    np.testing.assert_array_equal(assigned, nearest_by_brute_force(words, descriptors))


def test_assign_takes_views_and_read_only_arrays() -> None:
    vocabulary = make(5, 30)
    everything = np.random.default_rng(6).integers(0, 256, (50, 256), dtype=np.uint8)
    view = everything[::2, ::2]
    view.setflags(write=False)
    np.testing.assert_array_equal(vocabulary.assign(view), nearest_by_brute_force(vocabulary.words, view))


@pytest.mark.parametrize(
    "descriptors",
    [
        np.zeros((3, 128), np.float32),
        np.zeros((3, 64), np.uint8),
        np.zeros(128, np.uint8),
        np.full((2, 128), np.nan),
    ],
)
def test_descriptors_of_another_kind_are_refused(descriptors: np.ndarray) -> None:
    with pytest.raises(ObservationError, match=r"\(N, 128\) uint8"):
        make(7, 5).assign(descriptors)


@pytest.mark.parametrize("idf", [np.zeros(4, np.float32), np.full(4, np.nan, np.float32), np.ones(3, np.float32)])
def test_weights_must_be_positive_and_one_per_word(idf: np.ndarray) -> None:
    with pytest.raises(ObservationError):
        Vocabulary(np.zeros((4, 128), np.uint8), idf)


def test_the_hash_follows_words_and_weights_and_nothing_else() -> None:
    first = make(8, 10)
    same = Vocabulary(first.words.copy(), first.idf.copy(), {"seed": 3})
    assert first.hash == same.hash and len(first.hash) == 64
    words, idf = first.words.copy(), first.idf.copy()
    words[3, 5] ^= 1
    idf[0] += 1
    others = {Vocabulary(words, first.idf).hash, Vocabulary(first.words, idf).hash, first.hash}
    assert len(others) == 3


def test_words_and_weights_are_read_only() -> None:
    vocabulary = make(9, 10)
    for array in (vocabulary.words, vocabulary.idf):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_inverse_document_frequency_is_the_logarithm_of_the_share() -> None:
    idf = inverse_document_frequency(np.array([1, 5, 10, 0]), 10)
    np.testing.assert_allclose(idf, [np.log(10), np.log(2), MIN_IDF, np.log(10)], rtol=1e-6)
    assert idf.dtype == np.float32
