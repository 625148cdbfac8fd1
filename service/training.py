"""`seamark vocab train`: the images of sources to a vocabulary file."""

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame
from seamark.service.sources.base import Source
from seamark.vocab.training import train
from seamark.vocab.vocabulary import Vocabulary


def train_vocabulary(
    source: Source,
    n_words: int,
    out: Path,
    *,
    seed: int,
    config: FrontendConfig,
    progress: Callable[[str, int], None] | None = None,
) -> Vocabulary:
    """Describe every readable image, cluster the descriptors and save the words; raises SeamarkError.

    What was read is kept beside ``out`` until the words are there: the same training, begun again after it was
    interrupted, goes on from there.
    """

    def describe(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return extract_features(
            image, config.sift_features, config.sift_contrast, max_pixels=config.sift_pixels
        ).descriptors

    def batches() -> Iterator[Callable[[], NDArray[np.uint8]]]:
        for frame in source.frames():
            if isinstance(frame, Frame):
                yield partial(describe, frame.image)

    kept = checkpoint_path(source, out, seed, config)
    provenance = {"source": source.name}
    vocabulary = train(batches(), n_words, seed, provenance=provenance, progress=progress, checkpoint=kept)
    vocabulary.save(out)
    kept.unlink(missing_ok=True)
    return vocabulary


def checkpoint_path(source: Source, out: Path, seed: int, config: FrontendConfig) -> Path:
    """Return where a training keeps what it has read: another file for other images or other features."""
    features = (config.sift_features, config.sift_contrast, config.sift_pixels)
    key = hashlib.sha256(repr((source.name, source.n_frames, seed, features)).encode()).hexdigest()
    return out.with_name(f".{out.name}.{key[:12]}.training")
