"""Nearest words through cells, at every level of the processor, against numpy."""

import subprocess
import sys

import numpy as np
import pytest

from seamark.vocab.errors import ObservationError
from seamark.vocab.kernels import native
from seamark.vocab.vocabulary import Cells, Vocabulary

N_CELLS = 9


def squared(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return ((first[:, None].astype(np.int64) - second[None].astype(np.int64)) ** 2).sum(axis=2)


def reference(
    words: np.ndarray, centres: np.ndarray, offsets: np.ndarray, descriptors: np.ndarray, k: int, beam: int, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """The k nearest words of the cells that are looked into, written from the definition."""
    to_centre, to_word = squared(descriptors, centres), squared(descriptors, words)
    cell_of = np.repeat(np.arange(len(centres)), np.diff(offsets))
    nearest = np.full((len(descriptors), k), -1)
    distance = np.full((len(descriptors), k), 2**31 - 1)
    for i in range(len(descriptors)):
        cells = np.argsort(to_centre[i], kind="stable")[:beam]
        cells = cells[to_centre[i, cells] <= to_centre[i].min() + reach]
        inside = np.flatnonzero(np.isin(cell_of, cells))
        found = inside[np.argsort(to_word[i, inside], kind="stable")][:k]
        nearest[i, : len(found)], distance[i, : len(found)] = found, to_word[i, found]
    return nearest, distance


def problem(seed: int, n_words: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    sizes = rng.multinomial(n_words, rng.dirichlet(np.full(N_CELLS, 0.7)))  # some cells are empty, some have many
    centres = rng.integers(0, 256, (N_CELLS, 128), dtype=np.uint8)
    near = np.repeat(centres, sizes, axis=0).astype(int) + rng.integers(-60, 61, (n_words, 128))
    words = np.clip(near, 0, 255).astype(np.uint8)
    words[n_words // 2] = words[n_words // 3]  # twice, so that the lower of two must win
    mixed = (words[rng.integers(0, n_words, n)].astype(int) + words[rng.integers(0, n_words, n)]) // 2
    descriptors = np.clip(mixed + rng.integers(-9, 10, (n, 128)), 0, 255).astype(np.uint8)
    return words, centres, np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64), descriptors


@pytest.mark.parametrize("level", native.levels())
@pytest.mark.parametrize(("k", "beam", "reach"), [(1, 1, 2**31 - 1), (1, 4, 2**31 - 1), (3, 5, 200_000), (40, 9, 0)])
@pytest.mark.parametrize("n_words", [20, 700])
def test_assign_equals_the_reference(level: str, k: int, beam: int, reach: int, n_words: int) -> None:
    for seed, n in enumerate((1, 2, 3, 4, 5, 130)):
        words, centres, offsets, descriptors = problem(seed, n_words, n)
        quantiser = native.Quantiser(words, centres, offsets, level)
        assert quantiser.level == level
        nearest, distance = quantiser.assign(descriptors, k, beam, reach)
        expected = reference(words, centres, offsets, descriptors, k, beam, reach)
        np.testing.assert_array_equal(nearest, expected[0])
        np.testing.assert_array_equal(distance, expected[1])


@pytest.mark.parametrize("level", native.levels())
def test_extreme_descriptors_do_not_overflow(level: str) -> None:
    words = np.repeat(np.array([0, 255, 1, 254], np.uint8)[:, None], 128, axis=1)
    quantiser = native.Quantiser(words, words[:0], np.array([0, 4]), level)
    nearest, distance = quantiser.assign(words, 4)
    np.testing.assert_array_equal(nearest[:, 0], np.arange(4))
    np.testing.assert_array_equal(distance, np.sort(squared(words, words), axis=1))


@pytest.mark.parametrize("level", native.levels())
def test_more_descriptors_than_are_sorted_at_a_time(level: str) -> None:
    words, centres, offsets, _ = problem(3, 300, 1)
    rng = np.random.default_rng(4)
    descriptors = words[rng.integers(0, 300, 40_000)]
    nearest, distance = native.Quantiser(words, centres, offsets, level).assign(descriptors, 1, N_CELLS)
    np.testing.assert_array_equal(words[nearest[:, 0]], descriptors)
    assert not distance.any()


def test_a_vocabulary_looks_into_its_cells() -> None:
    words, centres, offsets, descriptors = problem(5, 500, 100)
    vocabulary = Vocabulary(words, np.ones(500, np.float32), cells=Cells(centres, offsets, 3, 100_000))
    expected = reference(words, centres, offsets, descriptors, 5, 3, 100_000)
    nearest, distance = vocabulary.assign_soft(descriptors, 5)
    np.testing.assert_array_equal(nearest, expected[0])
    np.testing.assert_array_equal(distance, expected[1])
    np.testing.assert_array_equal(vocabulary.assign(descriptors), expected[0][:, 0])
    assert vocabulary.assign(descriptors[:0]).shape == (0,)


@pytest.mark.parametrize(
    "cells",
    [
        Cells(np.zeros((2, 128), np.uint8), np.array([0, 5, 9]), 1, 0),
        Cells(np.zeros((2, 128), np.uint8), np.array([0, 12, 10]), 1, 0),
        Cells(np.zeros((2, 128), np.uint8), np.array([0, 10]), 1, 0),
        Cells(np.zeros((2, 128), np.uint8), np.array([0, 5, 10]), 3, 0),
        Cells(np.zeros((2, 128), np.uint8), np.array([0, 5, 10]), 1, -1),
        Cells(np.zeros((2, 64), np.uint8), np.array([0, 5, 10]), 1, 0),
    ],
)
def test_cells_that_do_not_fit_are_refused(cells: Cells) -> None:
    with pytest.raises(ObservationError):
        Vocabulary(np.zeros((10, 128), np.uint8), np.ones(10, np.float32), cells=cells)


def test_an_unknown_level_is_refused() -> None:
    with pytest.raises(ValueError, match="no level sse9"):
        native.Quantiser(np.zeros((1, 128), np.uint8), np.zeros((0, 128), np.uint8), np.array([0, 1]), "sse9")


def test_missing_kernels_are_named_with_their_remedy() -> None:
    code = "import sys; sys.modules['seamark.vocab._native'] = None; import seamark.vocab.vocabulary"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "KernelsMissingError: the compiled part of Seamark is missing" in done.stderr and "make setup" in done.stderr
