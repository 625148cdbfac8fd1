"""Train the vocabulary that ships, vocab/default.vocab, on generated and rendered images only.

    .venv/bin/python benchmarks/train_default_vocabulary.py

About ten CPU minutes on one core, nearly all of it images and their features: with --checkpoint FILE a run that was
stopped goes on. The same versions of numpy, OpenCV and sapien make the same file. Nothing here may ever read a
photograph: what the vocabulary is judged on, it has never seen.

What limits it is the imagery, not the clustering: 16k descriptors drawn at random from the same images serve real ones
as well as their k-means (gardens_point recall@1 .72 against .69, kitti06, euroc and hololens neighbours alike).
docs/benchmarks.md has what other imagery gave.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import sensor, specification
from seamark.datasets_synth.imagery import training_images
from seamark.datasets_synth.rendering import render_some
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features
from seamark.vocab import signatures
from seamark.vocab.training import train
from seamark.vocab.vocabulary import Vocabulary

DEFAULT_OUTPUT = Path(__file__).resolve().parent.parent / "vocab" / "default.vocab"


WORLDS = [
    f"{world},sensors=mono,camera=real,{light},seed={seed}"
    for seed, (world, light) in enumerate(
        (
            (world, light)
            for world in ("loop", "office", "hall", "street", "road")
            for light in ("condition=day", "condition=night,sensor=cheap")
        ),
        start=71,
    )
]


def rendered_images(per_world: int) -> Iterator[NDArray[np.uint8]]:
    """Yield frames of rendered worlds by day and, through a cheap camera, by night."""
    for text in WORLDS if per_world else ():
        wanted = specification.parse(text)
        indices = np.unique(np.linspace(0, wanted.frames - 1, per_world).astype(int)).tolist()
        for coded in render_some(wanted, indices):
            yield sensor.decode(coded, 0, "").image


def descriptor_batches(
    seed: int, n_images: int, n_features: int, per_world: int
) -> Iterator[Callable[[], NDArray[np.uint8]]]:
    """Yield what describes each image as the front end does."""
    config = FrontendConfig()
    for image in chain(training_images(seed, n_images), rendered_images(per_world)):
        yield (
            lambda image=image: (
                extract_features(image, n_features, config.sift_contrast, max_pixels=config.sift_pixels).descriptors
            )
        )


def with_projection(vocabulary: Vocabulary, seed: int) -> Vocabulary:
    """Return the vocabulary with directions for its signatures, learned from 60 more generated images."""
    batches = descriptor_batches(seed + 1, 60, 1000, 0)
    learned = np.concatenate([describe() for describe in batches])
    projection = signatures.learn_projection(learned, vocabulary.words, vocabulary.assign(learned))
    extras = {signatures.PROJECTION: projection}
    return Vocabulary(vocabulary.words, vocabulary.idf, vocabulary.provenance, cells=vocabulary.cells, extras=extras)


def show(stage: str, count: int) -> None:
    if stage != "reading" or count % 100 == 0:
        print(f"{stage} {count}  {time.process_time():.0f} s CPU", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=2100, help="generated")
    parser.add_argument("--per-world", type=int, default=40, help="rendered images of each of ten worlds")
    parser.add_argument("--features", type=int, default=1000, help="per image, as the front end takes them")
    parser.add_argument("--words", type=int, default=65536)
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUTPUT)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    provenance = {
        "images": "seamark.datasets_synth.imagery.training_images, 640x480, and rendered worlds",
        "worlds": WORLDS,
        "images_per_world": options.per_world,
        "image_seed": options.seed,
        "features_per_image": options.features,
        "versions": {name: version(name) for name in ("numpy", "opencv-contrib-python-headless", "sapien")},
        "licence": "Apache-2.0",
    }
    batches = descriptor_batches(options.seed, options.images, options.features, options.per_world)
    vocabulary = train(
        batches,
        options.words,
        options.seed,
        iterations=options.iterations,
        provenance=provenance,
        progress=show,
        checkpoint=options.checkpoint,
    )
    vocabulary = with_projection(vocabulary, options.seed)
    vocabulary.save(options.out)
    print(f"{options.out}: {vocabulary.n_words} words, {options.out.stat().st_size} bytes, {vocabulary.hash}")


if __name__ == "__main__":
    main()
