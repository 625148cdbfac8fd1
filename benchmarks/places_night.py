"""Day against a simulated night on real pictures: what is left of each cue, of the default and of order.

    .venv/bin/python benchmarks/places_night.py DAY OTHER_DAY [--models lamps grey dark] [--seeds 1] [--tolerance 3]

The pictures of OTHER_DAY are turned into night at full size: the sky goes dark, the sun's shading is evened out, lamps
that belong to the place light their surroundings and glare, the lens darkens to its corners, the sensor counts few
electrons, the camera moves while it exposes. ``lamps`` is a good camera in orange light, ``grey`` a poor one whose
pictures were stretched to full contrast and lost their colour, ``dark`` one without enough light for either. A picture
of a night is not a night: nothing that is switched on, closed or gone by night is in it.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from places import CUES, by_cues

from seamark.frontend.config import FrontendConfig
from seamark.service import places_metrics
from seamark.service.places_images import DescribedImage, describe_image
from seamark.service.places_search import search
from seamark.service.sources.decode import read_image
from seamark.service.sources.images import list_images
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary

Image = NDArray[np.uint8]
Light = NDArray[np.float32]
LAMP_IMAGES = 12  # a lamp stays in the picture for so many images and grows


@dataclass(frozen=True)
class Camera:
    """``exposure`` of the median, ``electrons`` at white, ``tint`` of the light (BGR); stretched to grey or not."""

    exposure: float
    electrons: float
    tint: tuple[float, float, float]
    stretched: bool
    lamps: float


MODELS = {
    "lamps": Camera(0.5, 250, (0.55, 0.85, 1.1), False, 1.0),
    "grey": Camera(0.3, 60, (1.0, 1.0, 1.0), True, 1.0),
    "dark": Camera(0.12, 60, (1.0, 1.0, 1.0), False, 0.15),
}
READ_NOISE = 3.0  # electrons


def without_sun(image: Image) -> Light:
    """Return linear light (H, W, 3): the sky dark, light and shade of the day evened out by more than half."""
    height, width = image.shape[:2]
    linear = (image.astype(np.float32) / 255) ** 2.2
    brightest, blue, red = image.max(axis=2), image[..., 0], image[..., 2]
    sky = ((brightest > 191) & ((blue >= 0.98 * red) | (brightest > 242))).astype(np.uint8)
    sky[int(0.7 * height) :] = 0
    sky = cv2.morphologyEx(sky, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    linear *= 1 - 0.97 * cv2.GaussianBlur(sky.astype(np.float32), (0, 0), 2)[..., None]
    shade = np.exp(cv2.GaussianBlur(np.log(linear.mean(axis=2) + 1e-3), (0, 0), width / 12))
    return np.asarray(linear * (0.25 * shade**-0.6)[..., None], np.float32)


def lamps_of(size: tuple[int, int], number: int, seed: int) -> tuple[Light, Light]:
    """Return what the lamps near an image throw on the scene, and their glare in the lens, both (H, W)."""
    height, width = size
    block, phase = divmod(number, LAMP_IMAGES)
    rng, grow = np.random.default_rng([seed, block]), 1 + phase / LAMP_IMAGES
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    light, glare = np.full((height, width), rng.uniform(0.03, 0.12), np.float32), np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(2, 7))):
        left, top = rng.uniform(0.1, 0.9) * width, rng.uniform(0.05, 0.5) * height
        squared = (x - width / 2 - (left - width / 2) * grow) ** 2
        squared += (y - 0.45 * height - (top - 0.45 * height) * grow) ** 2
        light += rng.uniform(0.3, 1.0) / (1 + squared / (rng.uniform(0.08, 0.3) * width * grow) ** 2)
        radius = rng.uniform(4, 12) * grow
        glare += 2.0 * np.exp(-squared / (2 * radius**2)) + 0.25 * np.exp(-squared / (72 * radius**2))
    return light, glare


def by_night(image: Image, number: int, seed: int, camera: Camera) -> Image:
    """Return image ``number`` of a walk as a camera sees it by night."""
    height, width = image.shape[:2]
    light, glare = lamps_of((height, width), number, seed)
    light = light if camera.lamps >= 1 else 0.1 + 0.5 * light.mean() * np.ones_like(light)
    linear = without_sun(image) * light[..., None] * np.array(camera.tint, np.float32)
    linear += camera.lamps * glare[..., None] * np.array([0.7, 0.9, 1.0], np.float32)
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-height / width, height / width, height))
    linear *= (1 / (1 + 0.8 * (x**2 + y**2)) ** 2).astype(np.float32)[..., None]
    rng = np.random.default_rng([seed, number, 7])
    linear *= camera.exposure / max(6 * float(np.median(linear)), 0.05) * rng.uniform(0.8, 1.2)
    counted = rng.poisson(np.clip(linear, 0, 1.2) * camera.electrons) + rng.normal(0, READ_NOISE, linear.shape)
    exposed = np.clip(counted / camera.electrons, 0, 1).astype(np.float32)
    exposed = cv2.blur(exposed, (int(rng.integers(1, 9)), 1))
    values = 255 * np.clip(cv2.GaussianBlur(exposed, (0, 0), 0.6), 0, 1) ** (1 / 2.2)
    if camera.stretched:
        grey = values.mean(axis=2)
        low, high = np.percentile(grey, (1, 99))
        values = np.repeat(np.clip((grey - low) / (high - low) * 255, 0, 255)[..., None], 3, axis=2)
    coded = cv2.imencode(".jpg", values.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


def recall(places: list[list[int]], truth: NDArray[np.bool_]) -> str:
    return "/".join(f"{places_metrics.recall_at(places, truth, n):.3f}" for n in (1, 5, 10))


def report(
    name: str, database: list[DescribedImage], queries: list[DescribedImage], tolerance: int, vocabulary: Vocabulary
) -> None:
    truth = np.abs(np.arange(len(queries))[:, None] - np.arange(len(database))[None]) <= tolerance
    row = [name]
    for cue in ("votes", "histograms", "view"):
        scores = by_cues(database, queries, vocabulary, CUES[cue])
        row.append(recall(np.argsort(-scores, axis=1, kind="stable")[:, :20].tolist(), truth))
    for in_order, together in ((False, False), (False, True), (True, True)):
        settings = {"top": 20, "in_order": in_order, "workers": 1, "together": together}
        found = search(database, queries, vocabulary, VocabConfig(), **settings)  # type: ignore[arg-type]
        first = np.array([truth[i, answer.matches[0].place] for i, answer in enumerate(found)])
        sure = np.array([answer.matches[0].accepted for answer in found])
        row.append(recall([[match.place for match in answer.matches] for answer in found], truth))
        row.append(f"{(sure & first).sum()}, {(sure & ~first).sum()}")
    print("| " + " | ".join(row) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("day", type=Path)
    parser.add_argument("other_day", type=Path)
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--tolerance", type=int, default=3)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary, config = Vocabulary.default(), FrontendConfig()
    database = [describe_image(read_image(path), path.name, config) for path in list_images(options.day)]
    print(
        "| night | votes | histograms | view | singly | right, wrong | together | right, wrong | order | right, wrong |"
    )
    print("|---" * 10 + "|")
    for model in options.models:
        for seed in range(1, options.seeds + 1):
            queries = [
                describe_image(by_night(read_image(path), number, seed, MODELS[model]), path.name, config)
                for number, path in enumerate(list_images(options.other_day))
            ]
            report(f"{model} {seed}", database, queries, options.tolerance, vocabulary)


if __name__ == "__main__":
    main()
