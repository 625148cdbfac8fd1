"""Training: deterministic, a fair sample, right weights."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from seamark.vocab.clustering import k_means, two_level_k_means
from seamark.vocab.errors import ObservationError, TrainingError
from seamark.vocab.training import document_frequency, sample_descriptors, train
from seamark.vocab.vocabulary import Cells, Vocabulary


def batches(seed: int, n_images: int, per_image: int, centres: int = 40) -> Iterator[np.ndarray]:
    """Descriptors near well separated centres, so that the clusters are known."""
    rng = np.random.default_rng(seed)
    around = np.random.default_rng(1000).integers(30, 220, (centres, 128))
    for _ in range(n_images):
        chosen = around[rng.integers(0, centres, per_image)]
        yield np.clip(chosen + rng.integers(-3, 4, (per_image, 128)), 0, 255).astype(np.uint8)


def silent(_stage: str, _count: int) -> None:
    pass


def test_two_trainings_are_equal_to_the_bit_and_the_seed_matters() -> None:
    first = train(batches(1, 20, 50), 60, seed=5)
    second = train(batches(1, 20, 50), 60, seed=5)
    other = train(batches(1, 20, 50), 60, seed=6)
    assert first.words.tobytes() == second.words.tobytes() and first.idf.tobytes() == second.idf.tobytes()
    assert first.hash == second.hash != other.hash
    assert first.n_words == 60


def test_words_settle_on_the_centres() -> None:
    vocabulary = train(batches(2, 30, 100), 80, seed=1)
    centres = np.random.default_rng(1000).integers(30, 220, (40, 128))
    distance = np.abs(centres[:, None] - vocabulary.words[None].astype(int)).mean(axis=2).min(axis=1)
    # The noise has a mean absolute value of 12/7; a word averages it away, a missed centre is about 70 away.
    assert np.mean(distance < 2) > 0.75


def test_the_sample_in_use_may_be_smaller_than_the_stream() -> None:
    vocabulary = train(batches(3, 40, 50), 30, seed=1, max_descriptors=500)
    assert vocabulary.provenance["n_descriptors"] == 2000
    assert vocabulary.provenance["n_sampled"] == 500
    assert vocabulary.provenance["n_images"] == 40
    assert vocabulary.hash == train(batches(3, 40, 50), 30, seed=1, max_descriptors=500).hash


def test_weights_are_those_of_the_training_images() -> None:
    data = list(batches(4, 25, 20))
    vocabulary = train(data, 50, seed=2)
    seen = [set(vocabulary.assign(batch).tolist()) for batch in data]
    for word in range(50):
        count = sum(word in words for words in seen)
        expected = max(np.log(25 / max(count, 1)), 1e-3)
        assert vocabulary.idf[word] == pytest.approx(expected, rel=1e-6)


def test_document_frequency_counts_an_image_once() -> None:
    frequency = document_frequency(np.array([2, 2, 0, 2, 0], np.int32), np.array([0, 0, 0, 1, 3], np.int32), 4)
    assert frequency.tolist() == [2, 0, 2, 0]


@pytest.mark.parametrize("per_image", [1, 3, 50, 400])
def test_every_descriptor_has_the_same_chance(per_image: int) -> None:
    """Number the descriptors of a stream and look where the numbers that were kept lie."""
    total, capacity = 2000, 200
    numbers = np.zeros((total, 128), np.uint8)
    numbers[:, :2] = np.stack(np.divmod(np.arange(total), 256), axis=1)
    positions = []
    for seed in range(20):
        sample = sample_descriptors(np.array_split(numbers, -(-total // per_image)), capacity, seed, silent)
        kept = sample.descriptors[:, 0].astype(int) * 256 + sample.descriptors[:, 1]
        assert len(np.unique(kept)) == capacity
        positions.append(kept)
    counts, _ = np.histogram(np.concatenate(positions), bins=10, range=(0, total))
    # 4000 draws in ten bins: 400 expected, standard deviation 19
    assert counts.min() > 310 and counts.max() < 490


def test_image_ids_stay_with_their_descriptors() -> None:
    stream = [np.full((10, 128), image, np.uint8) for image in range(100)]
    sample = sample_descriptors(iter(stream), 150, 3, silent)
    np.testing.assert_array_equal(sample.descriptors[:, 0], sample.image_ids)
    assert (sample.n_images, sample.n_seen, len(sample.descriptors)) == (100, 1000, 150)


def test_images_without_features_count_as_images() -> None:
    empty = np.zeros((0, 128), np.uint8)
    data = [batch for pair in zip(batches(5, 10, 30), [empty] * 10, strict=True) for batch in pair]
    assert train(data, 5, seed=1).provenance["n_images"] == 20


def test_two_levels_lose_little_against_one() -> None:
    """The cells of 40 centres: words at their place, sorted by cell, and almost as near as flat ones."""
    descriptors = np.concatenate(list(batches(8, 40, 100)))
    words, centres, offsets = two_level_k_means(descriptors, 160, 10, 3, 8, lambda _done: None)
    assert words.shape == (160, 128) and centres.shape == (10, 128)
    assert offsets[0] == 0 and offsets[-1] == 160 and (np.diff(offsets) >= 1).all()
    flat = Vocabulary(k_means(descriptors, 160, 3, 8), np.ones(160, np.float32))
    tree = Vocabulary(words, np.ones(160, np.float32), cells=Cells(centres, offsets, 10, 2**31 - 1))
    exact = Vocabulary(words, np.ones(160, np.float32))
    errors = [vocabulary.assign_soft(descriptors, 1)[1].mean() for vocabulary in (flat, tree)]
    assert 0.5 < errors[1] / errors[0] < 1.5
    np.testing.assert_array_equal(tree.assign(descriptors), exact.assign(descriptors))
    nearest = ((words[:, None].astype(int) - centres[None].astype(int)) ** 2).sum(axis=2).argmin(axis=1)
    assert np.mean(nearest == np.repeat(np.arange(10), np.diff(offsets))) > 0.9


def test_large_vocabularies_get_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("seamark.vocab.training.FLAT_UP_TO", 100)
    monkeypatch.setattr("seamark.vocab.training.WORDS_PER_CELL", 16)
    heard: list[tuple[str, int]] = []
    data = list(batches(9, 30, 60))
    vocabulary = train(data, 200, seed=4, progress=lambda stage, count: heard.append((stage, count)))
    assert vocabulary.cells is not None and len(vocabulary.cells.centres) == 13
    assert [count for stage, count in heard if stage == "clustering"] == list(range(1, 14))
    seen = [set(vocabulary.assign(batch).tolist()) for batch in data]
    counts = np.array([sum(word in words for words in seen) for word in range(200)])
    np.testing.assert_allclose(vocabulary.idf, np.maximum(np.log(30 / np.maximum(counts, 1)), 1e-3), rtol=1e-6)
    assert vocabulary.hash == train(data, 200, seed=4).hash


def test_an_empty_cluster_takes_the_farthest_descriptor() -> None:
    descriptors = np.zeros((50, 128), np.uint8)
    descriptors[7] = 200
    centres = k_means(descriptors, 2, 1, 3)
    assert sorted(centres[:, 0].tolist()) == [0, 200]


def test_a_training_that_was_killed_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("seamark.vocab.training.CHECKPOINT_IMAGES", 7)
    data = list(batches(10, 30, 40))
    computed: list[int] = []

    def stream(until: int) -> Iterator[Callable[[], np.ndarray]]:
        for number, batch in enumerate(data):
            if number == until:
                raise KeyboardInterrupt
            yield lambda number=number, batch=batch: (computed.append(number), batch)[1]

    checkpoint = tmp_path / "sample.npz"
    with pytest.raises(KeyboardInterrupt):
        train(stream(17), 50, seed=1, max_descriptors=300, checkpoint=checkpoint)
    computed.clear()
    resumed = train(stream(-1), 50, seed=1, max_descriptors=300, checkpoint=checkpoint)
    assert computed == list(range(14, 30))
    assert resumed.hash == train(data, 50, seed=1, max_descriptors=300).hash
    assert dict(resumed.provenance)["n_images"] == 30
    computed.clear()
    assert train(stream(-1), 50, seed=1, max_descriptors=300, checkpoint=checkpoint).hash == resumed.hash
    assert not computed
    with pytest.raises(TrainingError, match="seed 1, not of 300 and 2"):
        train(stream(-1), 50, seed=2, max_descriptors=300, checkpoint=checkpoint)
    with pytest.raises(TrainingError, match="the stream has 3"):
        train(data[:3], 50, seed=1, max_descriptors=300, checkpoint=checkpoint)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    with pytest.raises(TrainingError, match="damaged checkpoint"):
        train(data, 50, seed=1, max_descriptors=300, checkpoint=checkpoint)


def test_progress_is_reported_in_order() -> None:
    heard: list[tuple[str, int]] = []
    train(batches(6, 3, 30), 10, seed=1, iterations=4, progress=lambda stage, count: heard.append((stage, count)))
    assert heard == [("reading", 1), ("reading", 2), ("reading", 3), ("clustering", 1), ("weighting", 3)]


def test_too_few_descriptors_and_wrong_ones_are_refused() -> None:
    with pytest.raises(TrainingError, match="100 words of 60 descriptors"):
        train(batches(7, 2, 30), 100, seed=1)
    with pytest.raises(TrainingError, match="0 words"):
        train(batches(7, 2, 30), 0, seed=1)
    with pytest.raises(TrainingError):
        train([], 3, seed=1)
    with pytest.raises(ObservationError):
        train([np.zeros((30, 128), np.float32)], 3, seed=1)


def test_clusters_are_as_tight_as_those_of_faiss() -> None:
    """Another implementation of k-means, with centres in floating point and another start."""
    faiss = pytest.importorskip("faiss")
    rng = np.random.default_rng(12)
    middles = rng.integers(30, 200, (40, 128))
    descriptors = np.clip(middles[rng.integers(0, 40, 4000)] + rng.normal(0, 25, (4000, 128)), 0, 255).astype(np.uint8)
    other = faiss.Kmeans(128, 100, niter=8, seed=1, min_points_per_centroid=1, max_points_per_centroid=4000)
    other.train(descriptors.astype(np.float32))

    def error(centres: np.ndarray) -> float:
        squared = ((descriptors[:, None].astype(np.float32) - centres[None]) ** 2).sum(axis=2)
        return float(squared.min(axis=1).mean())

    assert error(k_means(descriptors, 100, 1, 8)) == pytest.approx(error(other.centroids), rel=0.1)
