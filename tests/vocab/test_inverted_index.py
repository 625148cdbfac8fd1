"""Voting against a dense computation of the same similarity, at every level of the processor."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seamark.vocab.errors import ObservationError, UnknownPlaceError
from seamark.vocab.inverted_index import InvertedIndex, best
from seamark.vocab.kernels import native

N_WORDS = 50
IDF = np.random.default_rng(99).uniform(0.1, 6, N_WORDS).astype(np.float32)
BLOCK = 7  # places: small, so that many blocks are sealed
TABLE = np.where(np.arange(65) <= 30, np.exp(-((np.arange(65) / 16) ** 2)), 0).astype(np.float32)


def dense(words: np.ndarray) -> np.ndarray:
    return np.sqrt(np.bincount(words, minlength=N_WORDS)) * IDF.astype(np.float64)


def similarity(first: np.ndarray, second: np.ndarray) -> float:
    smaller, greater = np.minimum(dense(first), dense(second)).sum(), max(dense(first).sum(), dense(second).sum())
    return float(smaller / greater) if greater else 0.0


def random_words(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.minimum(rng.geometric(0.08, size) - 1, N_WORDS - 1).astype(np.int32)


def random_place(rng: np.random.Generator, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Words, signatures near one of a few per word, geometry."""
    words = random_words(rng, size)
    kinds = np.random.default_rng(5).integers(0, 2**64, (N_WORDS, 3), dtype=np.uint64)
    flipped = np.bitwise_or.reduce(np.uint64(1) << rng.integers(0, 64, (size, 8), dtype=np.uint64), axis=1)
    signatures = kinds[words, rng.integers(0, 3, size)] ^ flipped
    return words, signatures, rng.integers(0, 2**16, size, dtype=np.uint16)


def near_reference(query: tuple[np.ndarray, ...], place: tuple[np.ndarray, ...], geometric: bool) -> float:
    """The similarity over all pairs of descriptors, from its definition."""
    (words, signatures, geometry), (other_words, other_signatures, other_geometry) = query, place
    if not len(words) or not len(other_words):
        return 0.0
    differing = signatures[:, None] ^ other_signatures[None]
    distance = np.unpackbits(differing.view(np.uint8).reshape(len(words), len(other_words), 8), axis=2).sum(axis=2)
    share = np.sqrt(np.bincount(words, minlength=N_WORDS)[words])
    other_share = np.sqrt(np.bincount(other_words, minlength=N_WORDS)[other_words])
    votes = (words[:, None] == other_words) * TABLE[distance] * IDF[words][:, None].astype(np.float64)
    votes = votes / share[:, None] / other_share / max(dense(words).sum(), dense(other_words).sum())
    if not geometric:
        return float(votes.sum())
    first, second = geometry.astype(int)[:, None], other_geometry.astype(int)[None]
    turn = ((second % 256 - first % 256 + 8) % 256) // 16
    growth = np.clip((second // 256 - first // 256 + 136) // 16, 0, 15)
    by_turn = np.bincount(turn.ravel(), votes.ravel(), minlength=16)
    by_growth = np.bincount(growth.ravel(), votes.ravel(), minlength=16)
    return float(min(by_turn.max(), by_growth.max()))


@pytest.mark.parametrize("level", native.levels())
@pytest.mark.parametrize("block_places", [BLOCK, 65536])
def test_votes_equal_the_dense_similarity(level: str, block_places: int) -> None:
    rng = np.random.default_rng(0)
    index = InvertedIndex(IDF, block_places=block_places, level=level)
    places = [random_words(rng, int(rng.integers(1, 60))) for _ in range(5 * BLOCK + 3)]
    assert [index.add(words) for words in places] == list(range(len(places)))
    for _ in range(20):
        query = random_words(rng, 40)
        votes = index.votes(query)
        assert votes.dtype == np.float32 and votes.shape == (len(places),)
        np.testing.assert_allclose(votes, [similarity(query, words) for words in places], atol=1e-6)


def test_votes_of_more_places_than_are_summed_at_a_time() -> None:
    """Sums are made over 8192 places at a time; the lists here are long, short, and empty in some of these sections."""
    rng = np.random.default_rng(11)
    words = np.minimum(rng.geometric(0.08, (20_000, 4)) - 1, N_WORDS - 5).astype(np.int32)
    words[rng.choice(20_000, 30), 0] = N_WORDS - 1
    words[[8191, 8192, 16383, 16384], 0] = N_WORDS - 2
    index = InvertedIndex(IDF, block_places=18_000)
    for place in words:
        index.add(place)
    index.remove(8192)
    query = np.array([0, 0, 0, 3, 3, 9, 44, 48, 49], np.int32)
    vectors = np.zeros((20_000, N_WORDS))
    np.add.at(vectors, (np.arange(20_000)[:, None], words), 1)
    vectors = np.sqrt(vectors) * IDF
    own = dense(query)
    expected = np.minimum(vectors, own).sum(axis=1) / np.maximum(vectors.sum(axis=1), own.sum())
    expected[8192] = 0
    votes = index.votes(query)
    np.testing.assert_allclose(votes, expected, atol=1e-6)
    assert votes[8191] > 0 and votes[16384] > 0


@pytest.mark.parametrize("level", native.levels())
@pytest.mark.parametrize("geometric", [False, True])
def test_near_votes_equal_the_sum_over_pairs(level: str, geometric: bool) -> None:
    rng = np.random.default_rng(1)
    index = InvertedIndex(IDF, with_signatures=True, with_geometry=True, block_places=BLOCK, level=level)
    places = [random_place(rng, int(rng.integers(0, 70))) for _ in range(3 * BLOCK + 2)]
    for place in places:
        index.add(*place)
    for _ in range(8):
        query = random_place(rng, 50)
        votes = index.near_votes(*query[:2], TABLE, query[2] if geometric else None)
        expected = [near_reference(query, place, geometric) for place in places]
        assert max(expected) > 0.02
        np.testing.assert_allclose(votes, expected, atol=1e-6)


def test_levels_agree_to_the_bit() -> None:
    answers = set()
    for level in native.levels():
        rng = np.random.default_rng(2)
        index = InvertedIndex(IDF, with_signatures=True, block_places=100, level=level)
        for _ in range(150):
            index.add(*random_place(rng, 60)[:2])
        query = random_place(rng, 60)
        answers.add(index.near_votes(*query[:2], TABLE).tobytes() + index.votes(query[0]).tobytes())
    assert len(answers) == 1


def test_signatures_leave_the_plain_votes_as_they_are() -> None:
    rng = np.random.default_rng(3)
    plain, signed = InvertedIndex(IDF), InvertedIndex(IDF, with_signatures=True)
    for _ in range(20):
        words, signatures, _ = random_place(rng, 80)
        plain.add(words)
        signed.add(words, signatures)
    query = random_words(rng, 80)
    np.testing.assert_allclose(signed.votes(query), plain.votes(query), atol=5e-6)


def test_scores_do_not_depend_on_the_other_places() -> None:
    """So the rankings of shards merge exactly."""
    rng = np.random.default_rng(4)
    places = [random_words(rng, 50) for _ in range(60)]
    whole, shards = InvertedIndex(IDF, block_places=BLOCK), [InvertedIndex(IDF) for _ in range(3)]
    for number, words in enumerate(places):
        whole.add(words)
        shards[number % 3].add(words)
    query = random_words(rng, 50)
    together = np.stack([shard.votes(query) for shard in shards], axis=1).ravel()
    assert whole.votes(query).tobytes() == together.tobytes()


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


def test_a_word_that_fills_an_image_is_counted_to_its_limit() -> None:
    index = InvertedIndex(IDF)
    index.add(np.full(300, 7, np.int32))
    index.add(np.full(255, 7, np.int32))
    votes = index.votes(np.full(270, 7, np.int32))
    assert votes[1] == pytest.approx(1, abs=1e-6)
    assert votes[0] == votes[1]


@given(
    seed=st.integers(0, 10_000),
    actions=st.lists(st.one_of(st.integers(0, 80), st.sampled_from(["remove", "compact"])), min_size=1, max_size=80),
)
@settings(max_examples=60, deadline=None)
def test_any_order_of_adding_removing_and_compacting(seed: int, actions: list[int | str]) -> None:
    """A number adds a place of so many words; the index must forget completely."""
    rng = np.random.default_rng(seed)
    index = InvertedIndex(IDF, block_places=BLOCK)
    held: list[np.ndarray | None] = []
    for action in actions:
        living = [slot for slot, words in enumerate(held) if words is not None]
        if isinstance(action, int):
            held.append(random_words(rng, action))
            assert index.add(held[-1]) == len(held) - 1
        elif action == "compact":
            assert index.compact().tolist() == living
            held = [held[slot] for slot in living]
        elif living:
            slot = living[int(rng.integers(len(living)))]
            held[slot] = None
            index.remove(slot)
    assert len(index) == sum(words is not None for words in held) and index.n_slots == len(held)
    query = random_words(rng, 30)
    expected = [0.0 if words is None else similarity(query, words) for words in held]
    np.testing.assert_allclose(index.votes(query), expected, atol=1e-6)


def test_compacting_gives_the_memory_back() -> None:
    """A robot that adds and prunes for months must not grow."""
    rng = np.random.default_rng(1)
    index = InvertedIndex(IDF, block_places=16)
    sizes = []
    for _ in range(20):
        for slot in range(len(index)):
            index.remove(slot)
        index.compact()
        for _ in range(40):
            index.add(random_words(rng, 40))
        sizes.append(index.n_bytes)
    assert index.n_slots == len(index) == 40
    assert max(sizes) < 1.2 * min(sizes)


def test_two_indices_with_one_history_agree_to_the_bit() -> None:
    def build() -> np.ndarray:
        rng = np.random.default_rng(2)
        index = InvertedIndex(IDF)
        for _ in range(100):
            index.add(random_words(rng, 30))
        index.remove(17)
        return index.votes(random_words(rng, 30))

    assert build().tobytes() == build().tobytes()


def test_a_snapshot_goes_on_where_it_was_taken() -> None:
    """Saved in the middle of a block, loaded, added to: as if nothing had happened."""
    rng = np.random.default_rng(6)
    kinds = {"with_signatures": True, "with_geometry": True, "block_places": BLOCK}
    first, second = InvertedIndex(IDF, **kinds), InvertedIndex(IDF, **kinds)
    places = [random_place(rng, 40) for _ in range(2 * BLOCK + 3)]
    for place in places:
        first.add(*place)
    first.remove(4)
    second.attach(*first.snapshot())
    query = random_place(rng, 40)
    for _ in range(BLOCK):
        assert first.near_votes(*query[:2], TABLE).tobytes() == second.near_votes(*query[:2], TABLE).tobytes()
        place = random_place(rng, 40)
        assert first.add(*place) == second.add(*place)
    assert len(first) == len(second) == len(places) - 1 + BLOCK


def test_readers_go_on_while_one_thread_writes() -> None:
    """Every answer must be that of some moment: the votes of a place are right or the place is not there yet."""
    rng = np.random.default_rng(7)
    places = [random_words(rng, 40) for _ in range(400)]
    query = random_words(rng, 40)
    expected = np.array([similarity(query, words) for words in places])
    index = InvertedIndex(IDF, block_places=32)
    wrong, answers, done = [], [], threading.Event()

    def read() -> None:
        while not done.is_set():
            votes = index.votes(query)
            answers.append(len(votes))
            if not np.allclose(votes, expected[: len(votes)], atol=1e-6):
                wrong.append(len(votes))

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for words in places:
        index.add(words)
    done.set()
    for reader in readers:
        reader.join()
    assert answers and not wrong


def test_best_is_the_head_of_the_sorted_scores() -> None:
    rng = np.random.default_rng(8)
    for n, k in ((0, 3), (1, 0), (5, 9), (1000, 20), (1000, 1000)):
        scores = rng.integers(0, 50, n).astype(np.float32)
        np.testing.assert_array_equal(best(scores, k), np.lexsort((np.arange(n), -scores))[:k])


def test_wrong_words_and_slots_are_refused_and_change_nothing() -> None:
    index = InvertedIndex(IDF)
    index.add(np.array([1, 2], np.int32))
    for words in ([-1, 2], [N_WORDS]):
        with pytest.raises(ObservationError, match=r"0\.\.49"):
            index.add(np.array(words, np.int32))
        with pytest.raises(ObservationError):
            index.votes(np.array(words, np.int32))
    for array in (np.array([1.0, np.nan]), np.array([1, 2]), np.zeros((2, 2), np.int32)):
        with pytest.raises(ObservationError, match="int32"):
            index.add(array)
    for slot in (-1, 1, 100):
        with pytest.raises(UnknownPlaceError):
            index.remove(slot)
    index.remove(0)
    with pytest.raises(UnknownPlaceError):
        index.remove(0)
    assert len(index) == 0 and index.n_slots == 1


def test_signatures_must_be_where_the_index_has_them() -> None:
    words, signatures, geometry = random_place(np.random.default_rng(9), 10)
    plain = InvertedIndex(IDF)
    signed = InvertedIndex(IDF, with_signatures=True)
    whole = InvertedIndex(IDF, with_signatures=True, with_geometry=True)
    for index, arrays in (
        (plain, (words, signatures)),
        (signed, (words,)),
        (signed, (words, signatures[:5])),
        (signed, (words, signatures.astype(np.int64))),
        (signed, (words, signatures, geometry)),
        (whole, (words, signatures)),
        (whole, (words, signatures, geometry.astype(np.uint8))),
    ):
        with pytest.raises(ObservationError):
            index.add(*arrays)
        assert len(index) == 0
    for index, arrays in (
        (plain, (words, signatures, TABLE)),
        (signed, (words, signatures, TABLE, geometry)),
        (signed, (words, signatures, TABLE[:64])),
        (signed, (words, signatures, np.full(65, np.nan, np.float32))),
    ):
        with pytest.raises(ObservationError):
            index.near_votes(*arrays)
