"""Train the vocabulary that ships, vocab/default.vocab, on generated images only.

    .venv/bin/python benchmarks/train_default_vocabulary.py

About ten CPU minutes on one core, nearly all of it images and their features: with --checkpoint FILE a run that was
stopped goes on. The same versions of numpy and OpenCV make the same file. Nothing here may ever read a photograph: what
the vocabulary is judged on, it has never seen.

What limits it is the imagery, not the clustering: 16k descriptors drawn at random from the same images serve real ones
as well as their k-means (gardens_point recall@1 .72 against .69, kitti06, euroc and hololens neighbours alike).
"""

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.imagery import training_images
from seamark.frontend.features import extract_features
from seamark.vocab.training import train

DEFAULT_OUTPUT = Path(__file__).resolve().parent.parent / "vocab" / "default.vocab"


def descriptor_batches(seed: int, n_images: int, n_features: int) -> Iterator[Callable[[], NDArray[np.uint8]]]:
    for image in training_images(seed, n_images):
        yield lambda image=image: extract_features(image, n_features).descriptors


def show(stage: str, count: int) -> None:
    if stage != "reading" or count % 100 == 0:
        print(f"{stage} {count}  {time.process_time():.0f} s CPU", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=1200)
    parser.add_argument("--features", type=int, default=1000, help="per image, as the front end takes them")
    parser.add_argument("--words", type=int, default=65536)
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUTPUT)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    provenance = {
        "images": "seamark.datasets_synth.imagery.training_images, 640x480",
        "image_seed": options.seed,
        "features_per_image": options.features,
        "versions": {name: version(name) for name in ("numpy", "opencv-contrib-python-headless")},
        "licence": "Apache-2.0",
    }
    batches = descriptor_batches(options.seed, options.images, options.features)
    vocabulary = train(
        batches,
        options.words,
        options.seed,
        iterations=options.iterations,
        provenance=provenance,
        progress=show,
        checkpoint=options.checkpoint,
    )
    vocabulary.save(options.out)
    print(f"{options.out}: {vocabulary.n_words} words, {options.out.stat().st_size} bytes, {vocabulary.hash}")


if __name__ == "__main__":
    main()
