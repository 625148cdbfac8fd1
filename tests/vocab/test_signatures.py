"""Signatures: near descriptors differ in few bits, against a count by hand and a world of known differences."""

import numpy as np
import pytest

from seamark.vocab import signatures
from seamark.vocab.errors import ObservationError
from seamark.vocab.vocabulary import Vocabulary

RNG = np.random.default_rng(3)
WORDS = RNG.integers(40, 200, (50, 128), dtype=np.uint8)
ASSIGNED = RNG.integers(0, 50, 3000).astype(np.int32)
SPREAD = np.concatenate([np.full(64, 12.0), np.full(64, 2.0)])
DESCRIPTORS = np.clip(WORDS[ASSIGNED] + RNG.normal(0, 1, (3000, 128)) * SPREAD, 0, 255).astype(np.uint8)
PROJECTION = signatures.learn_projection(DESCRIPTORS, WORDS, ASSIGNED)


def bits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([int(x ^ y).bit_count() for x, y in zip(a, b, strict=True)])


def test_directions_are_those_of_most_difference() -> None:
    assert PROJECTION.shape == (64, 128) and PROJECTION.dtype == np.float32
    assert np.allclose(PROJECTION @ PROJECTION.T, np.eye(64), atol=1e-5)
    assert (PROJECTION[:, :64] ** 2).sum() > 63.5  # the first half of the dimensions varies six times as much
    again = signatures.learn_projection(DESCRIPTORS, WORDS, ASSIGNED)
    assert (again == PROJECTION).all()


def test_bits_say_on_which_side_of_the_word() -> None:
    signed = signatures.sign(DESCRIPTORS[:40], WORDS, ASSIGNED[:40], PROJECTION)
    assert signed.dtype == np.uint64
    for number, signature in enumerate(signed):
        difference = DESCRIPTORS[number].astype(float) - WORDS[ASSIGNED[number]]
        for bit in range(64):
            product = float(PROJECTION[bit] @ difference)
            assert abs(product) < 1e-3 or (int(signature) >> bit) & 1 == (product > 0)


def test_near_descriptors_differ_in_few_bits_and_others_in_half() -> None:
    noisy = np.clip(DESCRIPTORS + RNG.normal(0, 3, DESCRIPTORS.shape), 0, 255).astype(np.uint8)
    here = signatures.sign(DESCRIPTORS, WORDS, ASSIGNED, PROJECTION)
    near = bits(here, signatures.sign(noisy, WORDS, ASSIGNED, PROJECTION))
    far = bits(here, np.roll(here, 1))
    assert 2 < near.mean() < 10 and 30 < far.mean() < 34
    table = signatures.vote_table()
    assert table.shape == (65,) and table.dtype == np.float32 and table[0] == 1
    assert (np.diff(table) <= 0).all() and table[28] > 0 and table[29] == 0
    assert table[near].mean() > 0.85 and table[far].mean() < 0.1


def test_orientation_and_scale_become_bytes() -> None:
    angles = np.array([0, np.pi / 2, -np.pi / 2, 2 * np.pi], np.float32)
    scales = np.array([1, 1.5, 2.25, 1e9], np.float32)
    packed = signatures.geometry(angles, scales)
    assert packed.dtype == np.uint16
    assert (packed & 255).tolist() == [0, 64, 192, 0]
    assert (packed >> 8).tolist() == [0, 16, 32, 255]


def test_refuses_too_little_and_the_wrong_shape() -> None:
    with pytest.raises(ObservationError, match="at least 64"):
        signatures.learn_projection(DESCRIPTORS[:63], WORDS, ASSIGNED[:63])
    with pytest.raises(ObservationError, match="projection"):
        signatures.sign(DESCRIPTORS[:5], WORDS, ASSIGNED[:5], PROJECTION[:32])
    assert len(signatures.sign(DESCRIPTORS[:0], WORDS, ASSIGNED[:0], PROJECTION)) == 0


def test_general_directions_are_orthogonal_and_those_of_a_vocabulary_come_first() -> None:
    words, idf = np.zeros((3, 128), np.uint8), np.ones(3, np.float32)
    general = signatures.directions(Vocabulary(words, idf))
    assert general.shape == (64, 128) and set(np.unique(general)) == {-1.0, 1.0}
    np.testing.assert_array_equal(general @ general.T, 128 * np.eye(64))
    own = np.random.default_rng(0).normal(size=(64, 128)).astype(np.float32)
    brought = signatures.directions(Vocabulary(words, idf, extras={signatures.PROJECTION: own}))
    np.testing.assert_array_equal(brought, own)
