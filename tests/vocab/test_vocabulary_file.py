"""The vocabulary file: round trip, damage, versions."""

import hashlib
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from seamark.vocab import store
from seamark.vocab.errors import VocabularyFileError
from seamark.vocab.vocabulary import Cells, Vocabulary


@pytest.fixture
def vocabulary() -> Vocabulary:
    rng = np.random.default_rng(0)
    words = rng.integers(0, 256, (37, 128), dtype=np.uint8)
    return Vocabulary(words, rng.uniform(0.5, 5, 37).astype(np.float32), {"seed": 7, "made_of": "noise"})


@pytest.fixture
def path(tmp_path: Path, vocabulary: Vocabulary) -> Path:
    vocabulary.save(tmp_path / "some.vocab")
    return tmp_path / "some.vocab"


def test_what_is_saved_is_loaded(path: Path, vocabulary: Vocabulary) -> None:
    loaded = Vocabulary.load(path)
    np.testing.assert_array_equal(loaded.words, vocabulary.words)
    np.testing.assert_array_equal(loaded.idf, vocabulary.idf)
    assert (loaded.hash, dict(loaded.provenance)) == (vocabulary.hash, dict(vocabulary.provenance))
    assert (loaded.words.dtype, loaded.idf.dtype) == (np.uint8, np.float32)
    assert not loaded.words.flags.owndata and not loaded.words.flags.writeable


def test_the_layout_is_the_documented_one(path: Path, vocabulary: Vocabulary) -> None:
    """Read the file by hand, as another program would."""
    content = path.read_bytes()
    magic, version, header_length = struct.unpack_from("<8sII", content)
    assert (magic, version) == (b"SMVOCAB\0", 2)
    start = 48 + header_length
    assert start % 64 == 0
    sections = json.loads(content[48:start])["sections"]
    assert sections["idf"]["offset"] % 64 == sections["words"]["offset"] % 64 == 0
    assert (sections["idf"]["dtype"], sections["idf"]["shape"]) == ("<f4", [37])
    np.testing.assert_array_equal(np.frombuffer(content, "<f4", 37, sections["idf"]["offset"]), vocabulary.idf)
    words = np.frombuffer(content, np.uint8, 37 * 128, sections["words"]["offset"])
    np.testing.assert_array_equal(words.reshape(37, 128), vocabulary.words)


def test_version_1_is_still_read(tmp_path: Path, vocabulary: Vocabulary) -> None:
    header = json.dumps({"n_words": 37, "descriptor_size": 128, "provenance": {"seed": 7}}).encode()
    header = header.ljust(-(48 + len(header)) % 64 + len(header))
    body = header + vocabulary.idf.tobytes() + vocabulary.words.tobytes()
    preamble = struct.pack("<8sII", b"SMVOCAB\0", 1, len(header))
    old = tmp_path / "old.vocab"
    old.write_bytes(preamble + hashlib.sha256(preamble + body).digest() + body)
    loaded = Vocabulary.load(old)
    np.testing.assert_array_equal(loaded.words, vocabulary.words)
    assert loaded.hash == vocabulary.hash and loaded.cells is None and dict(loaded.provenance) == {"seed": 7}
    body = body[:-128]
    old.write_bytes(preamble + hashlib.sha256(preamble + body).digest() + body)
    with pytest.raises(VocabularyFileError, match="do not hold 37 words"):
        Vocabulary.load(old)


def test_cells_and_extras_travel_along(tmp_path: Path, vocabulary: Vocabulary) -> None:
    cells = Cells(vocabulary.words[:4].copy(), np.array([0, 10, 10, 20, 37]), 2, 5000)
    projection = np.random.default_rng(1).normal(size=(64, 128)).astype(np.float32)
    whole = Vocabulary(vocabulary.words, vocabulary.idf, {}, cells=cells, extras={"projection": projection})
    whole.save(tmp_path / "tree.vocab")
    loaded = Vocabulary.load(tmp_path / "tree.vocab")
    assert loaded.cells is not None and (loaded.cells.beam, loaded.cells.reach) == (2, 5000)
    np.testing.assert_array_equal(loaded.cells.centres, cells.centres)
    np.testing.assert_array_equal(loaded.cells.offsets, cells.offsets)
    assert loaded.extras.keys() == {"projection"}
    np.testing.assert_array_equal(loaded.extras["projection"], projection)
    assert loaded.hash == whole.hash != vocabulary.hash
    other = Vocabulary(vocabulary.words, vocabulary.idf, {}, cells=cells, extras={"projection": 2 * projection})
    assert other.hash != whole.hash


@pytest.mark.parametrize(
    "sections",
    [
        {"words": np.zeros((3, 128), np.uint8)},
        {"words": np.zeros((3, 128), np.uint8), "idf": np.ones(3, np.float32), "cell_centres": np.zeros((2, 128))},
        {"words": np.zeros((3, 128), np.float32), "idf": np.ones(3, np.float32)},
    ],
)
def test_sections_that_do_not_fit_are_refused(tmp_path: Path, sections: dict[str, np.ndarray]) -> None:
    store.write(tmp_path / "odd.vocab", sections, {})
    with pytest.raises(VocabularyFileError, match=r"odd\.vocab: damaged"):
        Vocabulary.load(tmp_path / "odd.vocab")


def test_saving_twice_gives_the_same_bytes_and_leaves_nothing_else(path: Path, vocabulary: Vocabulary) -> None:
    before = path.read_bytes()
    vocabulary.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["some.vocab"]


def test_a_mapped_vocabulary_outlives_its_file(path: Path, vocabulary: Vocabulary) -> None:
    loaded = Vocabulary.load(path)
    Vocabulary(vocabulary.words[:3].copy(), vocabulary.idf[:3].copy()).save(path)
    np.testing.assert_array_equal(loaded.words, vocabulary.words)
    assert Vocabulary.load(path).n_words == 3


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_file_is_refused(path: Path, share: float) -> None:
    content = path.read_bytes()
    damaged = path.with_name("truncated.vocab")
    damaged.write_bytes(content[: int(share * len(content))])
    with pytest.raises(VocabularyFileError, match=r"truncated\.vocab"):
        Vocabulary.load(damaged)


@pytest.mark.parametrize("keep", [0, 1, 7, 8, 15, 16, 47, 48, 60, -129, -128, -1])
def test_a_file_cut_at_a_seam_is_refused(path: Path, keep: int) -> None:
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(VocabularyFileError):
        Vocabulary.load(path)


@given(position=st.integers(0, 10_000), bit=st.integers(0, 7))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_one_flipped_bit_anywhere_is_found(path: Path, position: int, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[position % len(content)] ^= 1 << bit
    damaged = path.with_name("flipped.vocab")
    damaged.write_bytes(content)
    with pytest.raises(VocabularyFileError, match=r"flipped\.vocab"):
        Vocabulary.load(damaged)


def test_bytes_behind_the_end_are_refused(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(VocabularyFileError, match="checksum"):
        Vocabulary.load(path)


def test_another_version_is_named(path: Path) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, 8, 9)
    path.write_bytes(content)
    with pytest.raises(VocabularyFileError, match="version 9"):
        Vocabulary.load(path)


def test_another_kind_of_file_is_refused(path: Path) -> None:
    path.write_bytes(b"%YAML:1.0\n" * 100)
    with pytest.raises(VocabularyFileError, match="not a Seamark vocabulary"):
        Vocabulary.load(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.vocab", tmp_path):
        with pytest.raises(VocabularyFileError, match="cannot read"):
            Vocabulary.load(path)


def test_a_failed_save_leaves_the_old_file(path: Path, vocabulary: Vocabulary, tmp_path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(VocabularyFileError, match="not JSON"):
        Vocabulary(vocabulary.words, vocabulary.idf, {"when": object()}).save(path)
    assert path.read_bytes() == before
    with pytest.raises(VocabularyFileError, match="cannot write"):
        vocabulary.save(tmp_path / "no such folder" / "some.vocab")


def test_a_vocabulary_whose_weights_make_no_sense_is_refused(path: Path, vocabulary: Vocabulary) -> None:
    """A file with a right checksum and wrong content, as a faulty program could write it."""
    store.write(path, {"words": vocabulary.words, "idf": np.zeros(37, np.float32)}, {})
    with pytest.raises(VocabularyFileError, match=r"some\.vocab"):
        Vocabulary.load(path)


def test_a_named_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.vocab"
    os.mkfifo(pipe)
    with pytest.raises(VocabularyFileError, match="no file"):
        Vocabulary.load(pipe)
