"""Training of visual words from a stream of descriptors, with bounded memory and a fixed seed."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import TrainingError
from seamark.vocab.vocabulary import (
    DESCRIPTOR_SIZE,
    Vocabulary,
    check_descriptors,
    inverse_document_frequency,
)

Progress = Callable[[str, int], None]
"""Called with the name of the stage and the number of images read so far, or of the iterations that follow."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A uniform sample of a stream.

    ``descriptors`` (n, 128) uint8, ``image_ids`` (n,) int32 the batch each one came from, ``n_images`` and ``n_seen``
    the number of batches and descriptors in the whole stream.
    """

    descriptors: NDArray[np.uint8]
    image_ids: NDArray[np.int32]
    n_images: int
    n_seen: int


def train(
    descriptor_batches: Iterable[NDArray[np.uint8]],
    n_words: int,
    seed: int,
    *,
    max_descriptors: int = 1_000_000,
    iterations: int = 10,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Vocabulary:
    """Cluster descriptors to visual words by k-means (Lloyd, faiss) and count in how many images each word is seen.

    ``descriptor_batches`` gives one (N, 128) uint8 array for each image and is read once. At most ``max_descriptors``
    are kept, a uniform sample of all; the document frequencies are those of the sample. ``provenance`` is kept with the
    vocabulary beside the parameters of the training. Equal input and seed give equal bits: one thread is used.

    Raises:
        TrainingError: fewer descriptors than words.
        ObservationError: a batch of another shape or type.
    """
    report = progress or (lambda _stage, _count: None)
    sample = sample_descriptors(descriptor_batches, max_descriptors, seed, report)
    if n_words < 1 or len(sample.descriptors) < n_words:
        raise TrainingError(f"cannot make {n_words} words of {len(sample.descriptors)} descriptors")
    report("clustering", iterations)
    words = _cluster(sample.descriptors, n_words, seed, iterations)
    report("weighting", sample.n_images)
    unweighted = Vocabulary(words, np.ones(n_words, np.float32))
    frequency = document_frequency(unweighted.assign(sample.descriptors), sample.image_ids, n_words)
    recipe = {
        "n_images": sample.n_images,
        "n_descriptors": sample.n_seen,
        "n_sampled": len(sample.descriptors),
        "iterations": iterations,
        "seed": seed,
    }
    return Vocabulary(words, inverse_document_frequency(frequency, sample.n_images), recipe | (provenance or {}))


def sample_descriptors(batches: Iterable[NDArray[np.uint8]], capacity: int, seed: int, report: Progress) -> Sample:
    """Draw at most ``capacity`` descriptors uniformly from a stream (algorithm R, Vitter 1985).

    Raises:
        ObservationError: a batch of another shape or type.
    """
    random = np.random.default_rng(seed)
    descriptors = np.empty((capacity, DESCRIPTOR_SIZE), np.uint8)
    image_ids = np.empty(capacity, np.int32)
    n_seen = n_images = 0
    for batch in batches:
        check_descriptors(batch)
        order = np.arange(n_seen, n_seen + len(batch))
        # The i-th of the stream takes a random one of the first i + 1 seats, if that seat exists.
        seats = np.where(order < capacity, order, random.integers(0, order + 1))
        seated = np.flatnonzero(seats < capacity)
        # Of several that drew one seat the last keeps it.
        last = len(seated) - 1 - np.unique(seats[seated][::-1], return_index=True)[1]
        seated = seated[last]
        descriptors[seats[seated]] = batch[seated]
        image_ids[seats[seated]] = n_images
        n_seen += len(batch)
        n_images += 1
        report("reading", n_images)
    kept = min(n_seen, capacity)
    return Sample(descriptors[:kept], image_ids[:kept], n_images, n_seen)


def document_frequency(words: NDArray[np.int32], image_ids: NDArray[np.int32], n_words: int) -> NDArray[np.int64]:
    """Count for each word the images that show it; ``words`` and ``image_ids`` are (n,), the result (n_words,)."""
    pairs = np.unique(image_ids.astype(np.int64) * n_words + words)
    return np.bincount(pairs % n_words, minlength=n_words).astype(np.int64)


def _cluster(descriptors: NDArray[np.uint8], n_words: int, seed: int, iterations: int) -> NDArray[np.uint8]:
    faiss.omp_set_num_threads(1)
    parameters = faiss.ClusteringParameters()
    parameters.niter = iterations
    parameters.seed = seed
    parameters.min_points_per_centroid = 1
    parameters.max_points_per_centroid = len(descriptors)  # the default, 256, drops data without a word
    clustering = faiss.Clustering(DESCRIPTOR_SIZE, n_words, parameters)
    # The codec lets faiss read bytes and widen them block by block: a quarter of the memory.
    codec = faiss.IndexScalarQuantizer(DESCRIPTOR_SIZE, faiss.ScalarQuantizer.QT_8bit_direct)
    codec.is_trained = True
    clustering.train_encoded(descriptors, codec, faiss.IndexFlatL2(DESCRIPTOR_SIZE))
    centres = faiss.vector_to_array(clustering.centroids).reshape(n_words, DESCRIPTOR_SIZE)
    words: NDArray[np.uint8] = np.clip(np.rint(centres), 0, 255).astype(np.uint8)
    return words
