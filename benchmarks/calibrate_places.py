"""Find the weights in vocab/confidence.py: how probable is it that the best place of an image is the right one?

    .venv/bin/python benchmarks/calibrate_places.py

Pairs of image sets are rendered or generated, never photographs: the same way by day and by night, one world against
another (everything is wrong), both again with queries made worse (turned, small, noisy), and generated pictures against
warped ones in another light (half of them unknown). For the best place of each query it is known whether it is right:
nearer than NEAR, or farther than FAR (between them it is left out). Logistic regression with both classes given the
same weight; prints the weights and what they would accept.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import sensor, specification
from seamark.datasets_synth.imagery import photograph, training_images
from seamark.datasets_synth.rendering import render_some
from seamark.frontend.config import FrontendConfig
from seamark.service.places_images import DescribedImage, describe_image
from seamark.service.places_search import Answer, search
from seamark.vocab.confidence import ACCEPTED_FROM
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary

NEAR, FAR = (2.5, 30.0), (5.0, 60.0)  # m, degrees
NIGHT = "trajectory=second_traversal,condition=night,run=2"
DUSK = "trajectory=second_traversal,condition=dusk,run=3"
WORLDS = {
    "loop day": "loop,trajectory=loop,frames=780,sensors=mono,camera=real,seed=31",
    "loop night": f"loop,frames=780,sensors=mono,camera=real,seed=31,{NIGHT}",
    "street day": "street,frames=760,sensors=mono,camera=real,seed=32",
    "street night": f"street,frames=760,sensors=mono,camera=real,seed=32,{NIGHT}",
    "street dusk": f"street,frames=760,sensors=mono,camera=real,seed=32,{DUSK}",
    "road day": "road,trajectory=once,frames=800,sensors=mono,camera=real,seed=33",
}
PAIRS = (
    ("loop day", "loop night"),
    ("street day", "street night"),
    ("street day", "street dusk"),
    ("street day", "loop night"),
    ("loop day", "street dusk"),
    ("street night", "road day"),
    ("loop day", "road day"),
)


@dataclass(frozen=True, eq=False)
class Set:
    name: str
    images: list[DescribedImage]
    poses: NDArray[np.float64]
    worse: list[DescribedImage]


def worsened(rng: np.random.Generator, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image from another direction, through a poor camera, a third or half as large."""
    height, width = image.shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + rng.normal(0, 0.05 * width, (1, 2)) + rng.normal(0, 0.03 * width, (4, 2))
    H = cv2.getPerspectiveTransform(moved.astype(np.float32), corners)
    warped = np.asarray(cv2.warpPerspective(image, H, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8)
    factor = float(rng.uniform(0.3, 0.5))
    small = cv2.resize(warped, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return photograph(rng, np.asarray(small, np.uint8))


def rendered(name: str, count: int) -> Set:
    wanted = specification.parse(WORLDS[name])
    indices = np.unique(np.linspace(0, wanted.frames - 1, count).astype(int)).tolist()
    config, rng = FrontendConfig(), np.random.default_rng(40)
    images, worse = [], []
    for coded in render_some(wanted, indices):
        image = sensor.decode(coded, 0, "").image
        images.append(describe_image(image, str(coded.index), config))
        worse.append(describe_image(worsened(rng, image), str(coded.index), config))
    return Set(name, images, wanted.poses()[indices], worse)


def generated(count: int) -> tuple[Set, Set]:
    """Pictures as places 20 m apart, and other views of every second one; the rest of the queries is unknown."""
    config, rng = FrontendConfig(), np.random.default_rng(41)
    places = list(training_images(41, count))
    unknown = list(training_images(42, count))
    queries = []
    for number, place in enumerate(places):
        scene = place if number % 2 else unknown[number]
        corners = np.array([[0, 0], [639, 0], [639, 479], [0, 479]], np.float32)
        moved = corners + rng.normal(0, 25, (4, 2)).astype(np.float32)
        warped = cv2.warpPerspective(scene, cv2.getPerspectiveTransform(moved, corners), (640, 480))
        queries.append(photograph(rng, np.asarray(warped, np.uint8)))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 20.0 * np.arange(count)
    elsewhere = poses.copy()
    elsewhere[::2, 1, 3] = 1e6
    sets = [[describe_image(image, str(n), config) for n, image in enumerate(part)] for part in (places, queries)]
    return Set("generated", sets[0], poses, []), Set("generated again", sets[1], elsewhere, [])


def correctness(
    database: Set, queries: Set, answers: Sequence[Answer], *, one_world: bool
) -> Iterator[tuple[Answer, bool]]:
    for pose, answer in zip(queries.poses, answers, strict=True):
        place = database.poses[answer.matches[0].place]
        distance = float(np.linalg.norm(pose[:3, 3] - place[:3, 3]))
        cosine = (np.trace(pose[:3, :3].T @ place[:3, :3]) - 1) / 2
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        if not one_world or distance > FAR[0] or angle > FAR[1]:
            yield answer, False
        elif distance < NEAR[0] and angle < NEAR[1]:
            yield answer, True


def fit(features: NDArray[np.float64], right: NDArray[np.bool_], ridge: float = 1e-3) -> NDArray[np.float64]:
    """Logistic regression by Newton's method; features (n, k) without the constant, which comes first in the result."""
    middle, spread = features.mean(axis=0), features.std(axis=0)
    x = np.column_stack([np.ones(len(features)), (features - middle) / spread])
    balance = np.where(right, 0.5 / right.mean(), 0.5 / (~right).mean())
    weights = np.zeros(x.shape[1])
    penalty = ridge * len(x) * np.diag([0.0, *np.ones(features.shape[1])])
    for _ in range(100):
        p = 1 / (1 + np.exp(-x @ weights))
        gradient = x.T @ (balance * (right - p)) - penalty @ weights
        weights += np.linalg.solve((x * (balance * p * (1 - p))[:, None]).T @ x + penalty, gradient)
    slopes = weights[1:] / spread
    return np.array([weights[0] - slopes @ middle, *slopes])


def describe_fit(
    name: str, weights: NDArray[np.float64], features: NDArray[np.float64], right: NDArray[np.bool_]
) -> None:
    p = 1 / (1 + np.exp(-(weights[0] + features @ weights[1:])))
    accepted = p >= ACCEPTED_FROM
    print(f"{name}: {', '.join(f'{w:.4g}' for w in weights)}")
    print(
        f"  {right.sum()} right, {(~right).sum()} wrong; accepted {accepted[right].sum()} and {accepted[~right].sum()}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=120, help="of each set")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    sets = {name: rendered(name, options.images) for name in WORLDS}
    pairs = [(sets[a], sets[b], True) for a, b in PAIRS]
    pairs += [(sets[a], Set(f"{b}, worse", sets[b].worse, sets[b].poses, []), True) for a, b in PAIRS]
    pairs.append((*generated(options.images), False))
    for together in (False, True):
        calibrate(pairs, together=together)


def calibrate(pairs: Sequence[tuple[Set, Set, bool]], *, together: bool) -> None:
    """Print the weights for scores of the place index, or (together) without what the images of each set share."""
    vocabulary, config = Vocabulary.default(), VocabConfig()
    singles, ways = [], []
    for database, queries, ordered in pairs:
        one_world = database.name.split()[0] == queries.name.split()[0]
        for in_order, found in ((False, singles), (True, ways)):
            if in_order and not ordered:
                continue
            arguments = {"top": 1, "in_order": in_order, "workers": 1, "together": together}
            answers = search(database.images, queries.images, vocabulary, config, **arguments)  # type: ignore[arg-type]
            part = list(correctness(database, queries, answers, one_world=one_world))
            found += part
            scores = [f"{np.median([a.evidence for a, r in part if r == k] or [np.nan]):.3f}" for k in (True, False)]
            most = max((a.matches[0].inliers for a, r in part if not r), default=0)
            print(
                f"{database.name} <- {queries.name}, order {in_order}: right {sum(r for _, r in part)} of {len(part)}, "
                f"median score right/wrong {'/'.join(scores)}, most inliers of a wrong one {most}",
                flush=True,
            )
    name = "TRAVERSALS" if together else "AS_THEY_ARE"
    right = np.array([r for _, r in singles])
    x = np.array([(a.evidence, np.log1p(a.matches[0].inliers)) for a, _ in singles])
    describe_fit(f"{name}, single", fit(x, right), x, right)
    right = np.array([r for _, r in ways])
    x = np.array([(a.evidence,) for a, _ in ways])
    describe_fit(f"{name}, along a way", fit(x, right), x, right)


if __name__ == "__main__":
    main()
