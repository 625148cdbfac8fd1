"""`seamark vocab train`: the images of sources to a vocabulary file."""

from collections.abc import Callable, Iterator
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
    """Describe every readable image, cluster the descriptors and save the words; raises SeamarkError."""

    def batches() -> Iterator[NDArray[np.uint8]]:
        for frame in source.frames():
            if isinstance(frame, Frame):
                yield extract_features(
                    frame.image, config.sift_features, config.sift_contrast, max_pixels=config.sift_pixels
                ).descriptors

    vocabulary = train(batches(), n_words, seed, provenance={"source": source.name}, progress=progress)
    vocabulary.save(out)
    return vocabulary
