"""The index of places in worlds of known words: revisits, exclusion of the recent past, ranking, errors."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from seamark.vocab.config import VocabConfig
from seamark.vocab.errors import DuplicatePlaceError, ObservationError, UnknownPlaceError
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

N_WORDS = 3000
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    rng = np.random.default_rng(0)
    words = rng.integers(0, 256, (N_WORDS, 128), dtype=np.uint8)
    return Vocabulary(words, rng.uniform(0.5, 5, N_WORDS).astype(np.float32))


class World:
    """A row of places; each has words of its own and a colour of its own, images of it share most of both."""

    def __init__(self, vocabulary: Vocabulary, seed: int = 1) -> None:
        self._vocabulary = vocabulary
        self._rng = np.random.default_rng(seed)
        self._words = self._rng.integers(0, N_WORDS, (100, 60))
        self._colours = self._rng.integers(0, 200, (100, 3))

    def look(
        self, place: int, key: int, stamp_s: float = 0.0, session: int = 0, *, grey: bool = False
    ) -> PlaceObservation:
        words = self._words[place].copy()
        replaced = self._rng.random(60) < 0.4
        words[replaced] = self._rng.integers(0, N_WORDS, replaced.sum())
        noise = self._rng.integers(-10, 11, (60, 128))
        descriptors = np.clip(self._vocabulary.words[words].astype(int) + noise, 0, 255).astype(np.uint8)
        picture = np.clip(self._colours[place] + self._rng.integers(0, 56, (12, 16, 3)), 0, 255).astype(np.uint8)
        luma = np.rint(picture @ (0.114, 0.587, 0.299)).astype(np.uint8)
        thumbnail = luma if grey else picture
        points = np.zeros((60, 2), np.float32)
        return PlaceObservation(key, session, round(stamp_s * SECOND), descriptors, points, thumbnail)


def ids(candidates: Candidates) -> list[int]:
    return [candidate.id for candidate in candidates.ranked]


def blank(key: int, session: int = 0, stamp_s: float = 0.0, value: int = 0) -> PlaceObservation:
    nothing = np.zeros((0, 128), np.uint8)
    picture = np.full((4, 4), value, np.uint8)
    return PlaceObservation(key, session, round(stamp_s * SECOND), nothing, np.zeros((0, 2), np.float32), picture)


def test_a_second_round_finds_every_place_of_the_first(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary)
    answers = [index.step(world.look(place % 50, place, float(place))) for place in range(100)]
    assert len(index) == 100
    for place, answer in enumerate(answers[50:]):
        best = answer.ranked[0]
        assert answer.query_id == place + 50 and answer.stamp_ns == (place + 50) * SECOND
        assert best.id == place
        assert 0.12 < best.votes < 0.7  # each look keeps 60 % of the words, so 36 % are common
        assert best.votes > 1.5 * answer.ranked[1].votes
        assert 0 <= best.jeffrey < 0.2


@pytest.mark.parametrize(("trusted", "believed"), [(60, 1.0), (240, 0.25)])
def test_scores_fuse_the_cues_by_their_weights(vocabulary: Vocabulary, trusted: int, believed: float) -> None:
    world = World(vocabulary)  # each look has 60 features
    weights = {"votes_weight": 3, "histogram_weight": 1, "view_weight": 2}
    index = PlaceIndex(vocabulary, VocabConfig(**weights, trusted_features=trusted, candidates=100))
    for place in range(30):
        index.add(world.look(place, place))
    ranked = index.query(world.look(4, -1, session=-1)).ranked
    assert len(ranked) == 30
    for candidate in ranked:
        likeness = 1 - candidate.jeffrey / (2 * np.log(2))
        fused = (3 * believed * candidate.votes + likeness + 2 * candidate.view) / 6
        assert candidate.score == pytest.approx(fused, abs=1e-9)
        assert 0 <= candidate.score <= 1
    assert [c.score for c in ranked] == sorted((c.score for c in ranked), reverse=True)


def test_the_recent_past_is_excluded_by_count(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=0, exclude_recent_count=20, candidates=100))
    for key in range(50):
        index.add(world.look(0, key, stamp_s=1000.0 * key))
    assert sorted(ids(index.query(world.look(0, 50, stamp_s=50_000.0)))) == list(range(30))


def test_the_recent_past_is_excluded_by_time(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=5, exclude_recent_count=0, candidates=100))
    for key in range(20):
        index.add(world.look(0, key, stamp_s=float(key)))
    assert sorted(ids(index.query(world.look(0, 20, stamp_s=20.0)))) == list(range(16))  # 15 is exactly 5 s ago
    # An image from the middle of the session, asked again: its neighbours on both sides are near in time.
    assert sorted(ids(index.query(world.look(0, 99, stamp_s=10.0)))) == [0, 1, 2, 3, 4, 5, 15, 16, 17, 18, 19]


def test_a_camera_that_has_not_moved_on_has_no_past_there(vocabulary: Vocabulary) -> None:
    """Standing still is no revisit, however long it lasts; once the view has changed, all before is past."""
    world = World(vocabulary)
    settings = VocabConfig(exclude_recent_s=0, exclude_recent_count=0, candidates=100, exclude_covisible=0.12)
    index = PlaceIndex(vocabulary, settings)
    looks = [3, 3, 8, *[3] * 10]
    for key, place in enumerate(looks):
        index.add(world.look(place, key, stamp_s=1000.0 * key))
    assert sorted(ids(index.query(world.look(3, 50, stamp_s=50_000.0)))) == [0, 1, 2]
    assert sorted(ids(index.query(world.look(9, 50, stamp_s=50_000.0)))) == list(range(13))
    assert len(index.query(world.look(3, -1, session=-1)).ranked) == 13
    for key in (5, 6):
        index.remove(key)
    assert sorted(ids(index.query(world.look(3, 50, stamp_s=50_000.0)))) == [0, 1, 2]
    with pytest.raises(ValidationError):
        VocabConfig(exclude_covisible=0.0)


def test_signatures_tell_apart_what_one_word_lumps_together(vocabulary: Vocabulary) -> None:
    """Two places show the same words, but lie elsewhere within them: only signatures can rank the right one first."""
    rng = np.random.default_rng(8)
    words = rng.integers(0, N_WORDS, 80)
    aside = rng.choice(np.array([-25, 25]), (2, 80, 128))
    picture = np.full((12, 16, 3), 90, np.uint8)

    def look(place: int, key: int) -> PlaceObservation:
        exact = vocabulary.words[words].astype(int) + aside[place] + rng.integers(-4, 5, (80, 128))
        descriptors = np.clip(exact, 0, 255).astype(np.uint8)
        return PlaceObservation(key, key, 0, descriptors, np.zeros((80, 2), np.float32), picture)

    plain, signed = (PlaceIndex(vocabulary, VocabConfig(signatures=on)) for on in (False, True))
    for index in (plain, signed):
        for place in range(2):
            index.add(look(place, place))
    for place in range(2):
        same, other = (c.votes for c in sorted(plain.query(look(place, -1)).ranked, key=lambda c: c.id != place))
        assert same == pytest.approx(other, abs=0.02) and same > 0.9
        near = signed.query(look(place, -1)).ranked
        assert near[0].id == place and 0.6 < near[0].votes <= 1 and near[1].votes < 0.15


def test_geometry_tells_apart_places_whose_features_have_turned_differently(vocabulary: Vocabulary) -> None:
    """Two places show the same features; those of the right one are all turned by 40 degrees and twice as large."""
    rng = np.random.default_rng(9)
    words = rng.integers(0, N_WORDS, 80)
    picture = np.full((12, 16, 3), 90, np.uint8)
    angles, scales = rng.uniform(0, 2 * np.pi, (2, 80)), np.exp(rng.uniform(1, 3, (2, 80)))

    def look(key: int, place: int, turn: float = 0.0, growth: float = 1.0) -> PlaceObservation:
        descriptors = vocabulary.words[words]
        turned, grown = (angles[place] + turn) % (2 * np.pi), growth * scales[place]
        given = grown.astype(np.float32), turned.astype(np.float32)
        return PlaceObservation(key, key, 0, descriptors, np.zeros((80, 2), np.float32), picture, *given)

    signed, whole = (PlaceIndex(vocabulary, VocabConfig(signatures=True, geometry=on)) for on in (False, True))
    shards = [PlaceIndex(vocabulary, whole.config) for _ in range(2)]
    for place in range(2):
        for index in (signed, whole, shards[place]):
            index.add(look(place, place))
    for place in range(2):
        query = look(-1, place, np.deg2rad(40), 2.0)
        same, other = signed.query(query).ranked
        assert same.votes == pytest.approx(other.votes, abs=1e-6) and same.votes > 0.9
        first, second = whole.query(query).ranked
        assert first.id == place and first.votes > 0.9 and second.votes < 0.5
        merged = sorted((c for shard in shards for c in shard.query(query).ranked), key=lambda c: -c.score)
        assert merged == [first, second]
    plain = replace(look(5, 0), scales=None)
    wrong = (plain, replace(look(5, 0), angles=np.full(80, np.nan, np.float32)), replace(look(5, 0), scales=scales[0]))
    for bad in wrong:
        with pytest.raises(ObservationError, match="float32 and finite"):
            whole.add(bad)
    assert len(whole) == 2 and signed.query(plain).ranked
    with pytest.raises(ValidationError, match="signatures must be true"):
        VocabConfig(geometry=True)


def test_time_and_count_add_up(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=5, exclude_recent_count=8, candidates=100))
    for key in range(20):
        index.add(world.look(0, key, stamp_s=0.5 * key))
    assert sorted(ids(index.query(world.look(0, 20, stamp_s=10.0)))) == list(range(11))
    assert sorted(ids(index.query(world.look(0, 20, stamp_s=100.0)))) == list(range(12))


def test_other_sessions_are_never_excluded(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(candidates=100))
    for key in range(5):
        index.add(world.look(0, key, session=0))
    for key in range(5, 10):
        index.add(world.look(0, key, session=1))
    assert sorted(ids(index.query(world.look(0, 10, session=1)))) == [0, 1, 2, 3, 4]
    assert sorted(ids(index.query(world.look(0, -1, session=-1)))) == list(range(10))


def test_an_image_is_no_candidate_for_itself(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=0, exclude_recent_count=0))
    observation = world.look(0, 7)
    index.add(observation)
    index.add(world.look(0, 8))
    assert ids(index.query(observation)) == [8]


def test_removal_does_not_shift_the_recent_past(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=0, exclude_recent_count=3, candidates=100))
    for key in range(10):
        index.add(world.look(0, key))
    index.remove(8)
    assert sorted(ids(index.query(world.look(0, 10)))) == [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("limit", [1, 3, 7, 20])
def test_equal_scores_are_ranked_by_id(vocabulary: Vocabulary, limit: int) -> None:
    index = PlaceIndex(vocabulary)
    for key in (9, 4, 11, 2, 7):
        index.add(blank(key))
    for key in (1, 30):
        index.add(blank(key, value=255))
    assert ids(index.query(blank(-1, session=-1), limit)) == [2, 4, 7, 9, 11, 1, 30][:limit]


def test_images_without_features_are_ranked_by_their_histograms(vocabulary: Vocabulary) -> None:
    index = PlaceIndex(vocabulary)
    for key, value in enumerate((0, 90, 180)):
        index.add(blank(key, value=value))
    answer = index.query(blank(-1, session=-1, value=95))
    assert answer.ranked[0].id == 1
    assert [candidate.votes for candidate in answer.ranked] == [0, 0, 0]


def test_grey_and_colour_images_compare(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary)
    for place in range(20):
        index.add(world.look(place, place, grey=place % 2 == 0))
    for place in range(20):
        for grey in (False, True):
            best = index.query(world.look(place, -1, session=-1, grey=grey)).ranked[0]
            assert best.id == place and 0 <= best.jeffrey < 0.7


def test_an_empty_index_answers_with_nothing(vocabulary: Vocabulary) -> None:
    index = PlaceIndex(vocabulary)
    assert index.query(blank(-1, session=-1)).ranked == ()
    assert index.step(blank(0)).ranked == ()
    assert len(index) == 1


def test_a_place_is_added_once(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary)
    index.add(world.look(0, 5))
    for again in (index.add, index.step):
        with pytest.raises(DuplicatePlaceError, match="place 5"):
            again(world.look(1, 5))
    assert len(index) == 1


def test_a_removed_place_is_forgotten_and_may_return(vocabulary: Vocabulary) -> None:
    world = World(vocabulary)
    index = PlaceIndex(vocabulary, VocabConfig(candidates=100))
    for place in range(10):
        index.add(world.look(place, place))
    index.remove(3)
    assert 3 not in index and 4 in index and len(index) == 9
    assert 3 not in ids(index.query(world.look(3, -1, session=-1)))
    with pytest.raises(UnknownPlaceError, match="place 3"):
        index.remove(3)
    index.add(world.look(3, 3))
    assert index.query(world.look(3, -1, session=-1)).ranked[0].id == 3


@pytest.mark.parametrize(
    ("descriptors", "thumbnail"),
    [
        (np.zeros((4, 128), np.float32), np.zeros((4, 4), np.uint8)),
        (np.zeros((4, 32), np.uint8), np.zeros((4, 4), np.uint8)),
        (np.zeros((4, 128), np.uint8), np.zeros((4, 4), np.float64)),
        (np.zeros((4, 128), np.uint8), np.zeros((0, 4), np.uint8)),
    ],
)
def test_bad_observations_change_nothing(
    vocabulary: Vocabulary, descriptors: np.ndarray, thumbnail: np.ndarray
) -> None:
    index = PlaceIndex(vocabulary)
    bad = PlaceObservation(0, 0, 0, descriptors, np.zeros((4, 2), np.float32), thumbnail)
    for action in (index.add, index.step, index.query):
        with pytest.raises(ObservationError):
            action(bad)
    assert len(index) == 0
    index.add(blank(0))


def test_two_indices_with_one_history_answer_alike(vocabulary: Vocabulary) -> None:
    def run() -> list[Candidates]:
        world = World(vocabulary, seed=5)
        index = PlaceIndex(vocabulary)
        return [index.step(world.look(key % 30, key, float(key))) for key in range(90)]

    assert run() == run()


def test_some_cue_must_count() -> None:
    with pytest.raises(ValidationError, match="must not all be 0"):
        VocabConfig(votes_weight=0, histogram_weight=0, view_weight=0)


def test_soft_assignment_finds_features_that_fell_into_a_neighbouring_word() -> None:
    """Test: words come in pairs so near that noise decides between both. Expected: with two words each nothing is lost.

    The likeness is that of equal images again, since what an image shows is counted by its nearest words.
    """
    rng = np.random.default_rng(3)
    one = rng.integers(20, 230, (200, 128))
    apart = rng.choice([-2, 2], one.shape)
    words = np.concatenate([one - apart, one + apart]).astype(np.uint8)
    pairs = Vocabulary(words, np.ones(400, np.float32))

    def look(key: int, session: int) -> PlaceObservation:
        seen = np.clip(one[:60] + rng.integers(-9, 10, (60, 128)), 0, 255).astype(np.uint8)
        return PlaceObservation(key, session, 0, seen, np.zeros((60, 2), np.float32), np.zeros((4, 4), np.uint8))

    votes = []
    for soft_words in (1, 2):
        index = PlaceIndex(pairs, VocabConfig(soft_words=soft_words))
        index.add(look(0, 0))
        votes.append(index.query(look(1, 1)).ranked[0].votes)
    assert 0.3 < votes[0] < 0.8  # half of the features fall into the other word of their pair
    assert votes[1] == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ValidationError, match="nearest word"):
        VocabConfig(soft_words=2, signatures=True)
