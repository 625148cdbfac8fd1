"""Voting against a dense computation of the same similarity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seamark.vocab.errors import ObservationError, UnknownPlaceError
from seamark.vocab.inverted_index import BLOCK, InvertedIndex

N_WORDS = 50
IDF = np.random.default_rng(99).uniform(0.1, 6, N_WORDS).astype(np.float32)


def dense(words: np.ndarray) -> np.ndarray:
    weights = np.sqrt(np.bincount(words, minlength=N_WORDS)) * IDF.astype(np.float64)
    return weights / max(weights.sum(), 1e-30)


def similarity(first: np.ndarray, second: np.ndarray) -> float:
    """1 - |p - q|_1 / 2 as defined, for images with words; nothing in common otherwise."""
    if not len(first) or not len(second):
        return 0.0
    return 1 - np.abs(dense(first) - dense(second)).sum() / 2


def random_words(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.minimum(rng.geometric(0.08, size) - 1, N_WORDS - 1).astype(np.int32)


def test_votes_equal_the_dense_similarity() -> None:
    rng = np.random.default_rng(0)
    index = InvertedIndex(IDF)
    places = [random_words(rng, int(rng.integers(1, 60))) for _ in range(5 * BLOCK + 3)]
    assert [index.add(words) for words in places] == list(range(len(places)))
    for _ in range(20):
        query = random_words(rng, 40)
        votes = index.votes(query)
        assert votes.dtype == np.float32 and votes.shape == (len(places),)
        np.testing.assert_allclose(votes, [similarity(query, words) for words in places], atol=2e-6)


def test_an_image_is_wholly_like_itself_and_unlike_one_without_common_words() -> None:
    index = InvertedIndex(IDF)
    index.add(np.array([1, 1, 2, 9], np.int32))
    index.add(np.array([3, 4], np.int32))
    np.testing.assert_allclose(index.votes(np.array([9, 1, 2, 1], np.int32)), [1, 0], atol=1e-6)
    assert index.votes(np.array([9, 1, 2, 1], np.int32)).max() <= 1


def test_an_image_without_words_is_like_nothing() -> None:
    index = InvertedIndex(IDF)
    nothing = np.zeros(0, np.int32)
    assert index.votes(nothing).shape == (0,)
    index.add(nothing)
    index.add(np.array([3], np.int32))
    assert index.votes(nothing).tolist() == [0, 0]
    np.testing.assert_allclose(index.votes(np.array([3], np.int32)), [0, 1])
    index.remove(0)
    assert len(index) == 1


@given(
    seed=st.integers(0, 10_000),
    actions=st.lists(st.one_of(st.integers(0, 80), st.none()), min_size=1, max_size=120),
)
@settings(max_examples=60, deadline=None)
def test_any_order_of_adding_and_removing(seed: int, actions: list[int | None]) -> None:
    """A number adds a place of so many words, None removes one; the index must forget completely."""
    rng = np.random.default_rng(seed)
    index = InvertedIndex(IDF)
    held: dict[int, np.ndarray] = {}
    for action in actions:
        if action is not None:
            words = random_words(rng, action)
            slot = index.add(words)
            assert slot not in held
            held[slot] = words
        elif held:
            slot = list(held)[int(rng.integers(len(held)))]
            del held[slot]
            index.remove(slot)
    assert len(index) == len(held) <= index.n_slots
    query = random_words(rng, 30)
    expected = np.zeros(index.n_slots)
    for slot, words in held.items():
        expected[slot] = similarity(query, words)
    np.testing.assert_allclose(index.votes(query), expected, atol=2e-6)


def test_slots_and_blocks_are_used_again() -> None:
    """A robot that adds and prunes for months must not grow."""
    rng = np.random.default_rng(1)
    index = InvertedIndex(IDF)
    slots = [index.add(random_words(rng, 40)) for _ in range(40)]
    for _ in range(30):
        for slot in slots:
            index.remove(slot)
        slots = [index.add(random_words(rng, 40)) for _ in range(40)]
    assert index.n_slots == 40
    assert index._n_blocks <= 3 * N_WORDS


def test_two_indices_with_one_history_agree_to_the_bit() -> None:
    def build() -> np.ndarray:
        rng = np.random.default_rng(2)
        index = InvertedIndex(IDF)
        for _ in range(100):
            index.add(random_words(rng, 30))
        index.remove(17)
        return index.votes(random_words(rng, 30))

    assert build().tobytes() == build().tobytes()


def test_wrong_words_and_slots_are_refused_and_change_nothing() -> None:
    index = InvertedIndex(IDF)
    index.add(np.array([1, 2], np.int32))
    for words in ([-1, 2], [N_WORDS]):
        with pytest.raises(ObservationError, match=r"0\.\.49"):
            index.add(np.array(words, np.int32))
        with pytest.raises(ObservationError):
            index.votes(np.array(words, np.int32))
    for slot in (-1, 1, 100):
        with pytest.raises(UnknownPlaceError):
            index.remove(slot)
    index.remove(0)
    with pytest.raises(UnknownPlaceError):
        index.remove(0)
    assert len(index) == 0 and index.n_slots == 1
