"""The place index on disk: round trip, damage, other vocabularies, writing while queries go on."""

import hashlib
import json
import os
import struct
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from seamark.vocab import index_file
from seamark.vocab.config import VocabConfig
from seamark.vocab.errors import DuplicatePlaceError, IndexFileError
from seamark.vocab.inverted_index import InvertedIndex
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

SECOND = 1_000_000_000


def make_vocabulary(seed: int) -> Vocabulary:
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 256, (80, 128), dtype=np.uint8)
    return Vocabulary(words, rng.uniform(0.5, 5, 80).astype(np.float32))


VOCABULARY = make_vocabulary(0)


def observe(number: int, session: int = 0, n: int = 30) -> PlaceObservation:
    rng = np.random.default_rng(number % 1000)
    words = VOCABULARY.words[rng.integers(0, 80, n)].astype(int) + rng.integers(-3, 4, (n, 128))
    descriptors = np.clip(words, 0, 255).astype(np.uint8)
    thumbnail = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    scales, angles = np.exp(rng.uniform(0.5, 3, (1, n)))[0], rng.uniform(0, 6.28, n)
    points = np.zeros((n, 2), np.float32)
    given = scales.astype(np.float32), angles.astype(np.float32)
    return PlaceObservation(number, session, number * SECOND, descriptors, points, thumbnail, *given)


def filled(n: int = 40) -> PlaceIndex:
    index = PlaceIndex(VOCABULARY)
    for number in range(n):
        index.add(observe(number, n=number % 35))  # the first has no features
    return index


@pytest.fixture
def path(tmp_path: Path) -> Path:
    filled().save(tmp_path / "some.places")
    return tmp_path / "some.places"


def test_what_is_saved_answers_the_same_and_goes_on_the_same(tmp_path: Path) -> None:
    index = filled()
    index.remove(7)
    index.save(tmp_path / "some.places")
    loaded = PlaceIndex.load(tmp_path / "some.places", VOCABULARY)
    assert len(loaded) == len(index) == 39 and 7 not in loaded and 8 in loaded
    for number in range(1000, 1040):
        query = observe(number, session=number % 2)
        assert loaded.query(query, 40) == index.query(query, 40)
    for number in (7, 90, 91):
        assert loaded.step(observe(number)) == index.step(observe(number))
    with pytest.raises(DuplicatePlaceError):
        loaded.add(observe(8))
    loaded.remove(8)
    index.remove(8)
    assert loaded.query(observe(1008, 1), 40) == index.query(observe(1008, 1), 40)


@pytest.mark.parametrize("geometry", [False, True])
def test_an_index_with_signatures_is_kept_with_them(path: Path, tmp_path: Path, *, geometry: bool) -> None:
    config = VocabConfig(signatures=True, geometry=geometry)
    index = PlaceIndex(VOCABULARY, config)
    for number in range(40):
        index.add(observe(number, n=number % 35))
    index.save(tmp_path / "signed.places")
    loaded = PlaceIndex.load(tmp_path / "signed.places", VOCABULARY, config)
    for number in (1000, 1017, 1033):
        assert loaded.query(observe(number), 40) == index.query(observe(number), 40)
    loaded.add(observe(1041))
    with pytest.raises(IndexFileError, match="with signatures"):
        PlaceIndex.load(tmp_path / "signed.places", VOCABULARY)
    with pytest.raises(IndexFileError, match="without signatures"):
        PlaceIndex.load(path, VOCABULARY, config)
    with pytest.raises(IndexFileError, match="without geometry" if not geometry else "with geometry"):
        PlaceIndex.load(tmp_path / "signed.places", VOCABULARY, VocabConfig(signatures=True, geometry=not geometry))


def test_saving_a_loaded_index_writes_the_same_bytes(path: Path, tmp_path: Path) -> None:
    PlaceIndex.load(path, VOCABULARY).save(tmp_path / "again.places")
    assert (tmp_path / "again.places").read_bytes() == path.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.places", "some.places"]


def test_an_empty_index_is_saved_too(tmp_path: Path) -> None:
    PlaceIndex(VOCABULARY).save(tmp_path / "empty.places")
    loaded = PlaceIndex.load(tmp_path / "empty.places", VOCABULARY)
    assert len(loaded) == 0 and loaded.query(observe(1)).ranked == ()
    loaded.add(observe(1))
    assert len(loaded) == 1


def test_signatures_and_geometry_are_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    index = InvertedIndex(VOCABULARY.idf, with_signatures=True, with_geometry=True, block_places=5)
    for _ in range(13):
        words = rng.integers(0, 80, 20).astype(np.int32)
        signatures = rng.integers(0, 2**64, 20, dtype=np.uint64)
        index.add(words, signatures, rng.integers(0, 2**16, 20, dtype=np.uint16))
    query = words, signatures, np.ones(65, np.float32)
    index_file.save(tmp_path / "signed.places", "hash", index, index.snapshot(), {"a": 1}, {})
    opened = index_file.load(tmp_path / "signed.places")
    opened.verify_postings()
    loaded = opened.inverted_index(VOCABULARY.idf)
    assert opened.facts == {"a": 1} and loaded.block_places == 5
    assert loaded.near_votes(*query).tobytes() == index.near_votes(*query).tobytes()


def test_the_layout_is_the_documented_one(path: Path) -> None:
    """Read the file by hand, as another program would."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<8sII", content)
    assert (magic, version) == (b"SMPLACES", 1)
    assert content[16:48] == hashlib.sha256(content[:16] + content[48 : 48 + length]).digest()
    header = json.loads(content[48 : 48 + length])
    assert header["vocabulary"] == VOCABULARY.hash
    assert header["index"]["blocks"] == [40]
    for entry in header["sections"].values():
        size = int(np.prod(entry["shape"])) * np.dtype(entry["dtype"]).itemsize
        assert entry["offset"] % 64 == 0
        assert hashlib.sha256(content[entry["offset"] : entry["offset"] + size]).hexdigest() == entry["sha256"]


def use(path: Path) -> None:
    PlaceIndex.load(path, VOCABULARY).query(observe(1))


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_file_is_refused(path: Path, share: float) -> None:
    content = path.read_bytes()
    damaged = path.with_name("truncated.places")
    damaged.write_bytes(content[: int(share * len(content))])
    with pytest.raises(IndexFileError, match=r"truncated\.places"):
        PlaceIndex.load(damaged, VOCABULARY)


@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_one_flipped_bit_is_found_before_anything_is_answered(path: Path, share: float, bit: int) -> None:
    content = bytearray(path.read_bytes())
    position = int(share * len(content))
    (length,) = struct.unpack_from("<I", content, 12)
    sections = json.loads(bytes(content[48 : 48 + length]))["sections"].values()
    meant = position < 48 + length or any(
        entry["offset"] <= position < entry["offset"] + index_file._size(entry) for entry in sections
    )
    content[position] ^= 1 << bit
    damaged = path.with_name("flipped.places")
    damaged.write_bytes(content)
    if meant:
        with pytest.raises(IndexFileError, match=r"flipped\.places"):
            use(damaged)
    else:  # the blanks between sections say nothing
        use(damaged)


def test_postings_are_verified_at_the_first_use(path: Path) -> None:
    content = bytearray(path.read_bytes())
    (length,) = struct.unpack_from("<I", content, 12)
    ids = json.loads(bytes(content[48 : 48 + length]))["sections"]["block0.ids"]
    content[ids["offset"]] ^= 0xFF
    path.write_bytes(content)
    for act in (lambda i: i.query(observe(1)), lambda i: i.add(observe(99)), lambda i: i.remove(1)):
        index = PlaceIndex.load(path, VOCABULARY)
        assert len(index) == 40
        for _ in range(2):
            with pytest.raises(IndexFileError, match=r"checksum of block0\.ids"):
                act(index)
        with pytest.raises(IndexFileError):
            index.save(path)


def test_another_vocabulary_is_refused(path: Path) -> None:
    with pytest.raises(IndexFileError, match="made with the vocabulary"):
        PlaceIndex.load(path, make_vocabulary(1))


def test_other_settings_are_refused(path: Path) -> None:
    with pytest.raises(IndexFileError, match="made with other settings"):
        PlaceIndex.load(path, VOCABULARY, VocabConfig(histogram_bins=16))


def test_another_kind_of_file_a_missing_one_and_a_folder_are_refused(tmp_path: Path) -> None:
    VOCABULARY.save(tmp_path / "words.vocab")
    with pytest.raises(IndexFileError, match="not a Seamark place index"):
        PlaceIndex.load(tmp_path / "words.vocab", VOCABULARY)
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(IndexFileError, match="cannot read"):
            PlaceIndex.load(path, VOCABULARY)


def test_another_version_is_named(path: Path) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 8, 9)
    path.write_bytes(content)
    with pytest.raises(IndexFileError, match="version 9"):
        PlaceIndex.load(path, VOCABULARY)


def test_a_failed_save_leaves_the_old_file(path: Path, tmp_path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(IndexFileError, match="cannot write"):
        filled(3).save(tmp_path / "no such folder" / "some.places")
    assert path.read_bytes() == before


def test_every_file_written_beside_additions_holds_one_moment(tmp_path: Path) -> None:
    index = filled(10)
    done = threading.Event()

    def add() -> None:
        for number in range(10, 120):
            index.add(observe(number))
        done.set()

    writer = threading.Thread(target=add)
    writer.start()
    sizes = []
    while not done.is_set() or not sizes:
        index.save(tmp_path / "live.places")
        loaded = PlaceIndex.load(tmp_path / "live.places", VOCABULARY)
        sizes.append(len(loaded))
        answer = loaded.query(observe(1005, session=1), 1000)
        assert {candidate.id for candidate in answer.ranked} == set(range(len(loaded)))
    writer.join()
    assert sizes == sorted(sizes) and sizes[0] >= 10


def test_removing_most_places_gives_their_room_back() -> None:
    index = filled(300)
    for number in range(290):
        index.remove(number)
    assert index._inverted.n_slots < 100
    assert {c.id for c in index.query(observe(1295, session=1), 100).ranked} == set(range(290, 300))
    for number in range(290):
        index.add(observe(number))
    assert len(index) == 300


def test_a_named_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.places"
    os.mkfifo(pipe)
    with pytest.raises(IndexFileError, match="no file"):
        PlaceIndex.load(pipe, VOCABULARY)
