"""Places on rendered worlds: is a wrong place ever accepted, and what is left of recall at night?

    .venv/bin/python benchmarks/places_rendered.py safety twins office road [--seeds 3] [--first-seed 100]
    .venv/bin/python benchmarks/places_rendered.py night loop street road [--seed 100]

``safety`` shows every tenth frame of a lap in its order and asks each for places in its own past, by looks alone and
with odometry, each one by one and in order. Odometry is the true motion with an error ten times that of the front end:
its scale is off by 1 % (one sigma), and its heading drifts by 0.2 degrees per root of a metre.
Two images show one place when they share a quarter of the surface that they see (ground_truth.PlaceTruth); an accepted
answer is wrong when they share at most 2 per cent, and beside the place in between. ``night`` asks a night traverse
with a cheap camera, aside and looking aside, for places of the day; an answer is right within 3 m and 45 degrees.
``--keep DIR`` keeps there what is described of the images, whatever becomes of the worlds. Pictures are 320 x 240.
"""

import argparse
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import sensor, specification, trajectory
from seamark.datasets_synth.ground_truth import PlaceTruth, place_truth
from seamark.datasets_synth.rendering import render_some
from seamark.datasets_synth.worlds import WORLDS
from seamark.frontend.config import FrontendConfig
from seamark.service import places_metrics
from seamark.service.places_images import DescribedImage, describe_image
from seamark.service.places_motion import Motion
from seamark.service.places_search import Answer, search, search_own
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary

DAY = "camera=real,condition=day"
NIGHT = "camera=real,condition=night,run=2,trajectory=second_traversal,sensor=cheap"
PLAIN_WORDS = VocabConfig(histogram_weight=0.0, view_weight=0.0)
NEAR_M, NEAR_DEG = 3.0, 45.0
SCALE_ERROR, HEADING_ERROR_DEG = 0.01, 0.2


@dataclass(frozen=True, eq=False)
class Lap:
    """What was rendered: images, their stamps (N,), poses (N, 4, 4), and which share surface where depth tells."""

    images: list[DescribedImage]
    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    truth: PlaceTruth | None


def render(text: str, every: int, keep: Path | None) -> Lap:
    wanted = specification.parse(text)
    kept = None if keep is None else keep / f"{text}-{every}.pickle"
    if kept is not None and kept.exists():
        lap: Lap = pickle.loads(kept.read_bytes())
        return lap
    indices = list(range(0, wanted.frames, every))
    poses, stamps_ns = wanted.poses()[indices], trajectory.stamps(wanted.frames, specification.FPS)[indices]
    config, images, depths = FrontendConfig(), [], []
    for coded in render_some(wanted, indices):
        frame = sensor.decode(coded, 0, "")
        images.append(describe_image(frame.image, str(coded.index), config))
        if frame.depth is not None:
            depths.append(np.asarray(frame.depth, np.float32) / wanted.rig.depth_factor)
    lap = Lap(images, stamps_ns, poses, place_truth(depths, poses, wanted.rig.cam0) if depths else None)
    if kept is not None:
        kept.write_bytes(pickle.dumps(lap))
    return lap


def own_past(
    lap: Lap, vocabulary: Vocabulary, motion: Motion | None, *, in_order: bool
) -> tuple[list[Answer], NDArray[np.bool_]]:
    stamps = lap.stamps_ns.tolist()
    return search_own(
        lap.images, stamps, vocabulary, VocabConfig(), top=20, in_order=in_order, workers=1, motion=motion
    )


def poor_odometry(poses: NDArray[np.float64], seed: int) -> Motion:
    """Return the true motion with errors that add up."""
    rng = np.random.default_rng(seed)
    scale, said = 1.0 + rng.normal(0, SCALE_ERROR), [poses[0]]
    for before, after in pairwise(poses):
        step = np.linalg.inv(before) @ after
        angle = np.deg2rad(HEADING_ERROR_DEG) * np.sqrt(np.linalg.norm(step[:3, 3])) * rng.normal()
        step[:3, 3] *= scale
        step[:3, :3] = step[:3, :3] @ cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        said.append(said[-1] @ step)
    return Motion(np.stack(said), np.zeros(len(poses), np.int64), metric=True)


def safety(worlds: Sequence[str], seeds: Sequence[int], every: int, keep: Path | None, vocabulary: Vocabulary) -> None:
    print("| | images | asked | with a place | looks: @1 | accepted | in order | odometry: @1 | accepted | in order |")
    print("|---|" + "---|" * 9 + "  (accepted: right, beside, wrong)")
    for world in worlds:
        total = np.zeros((4, 3), np.int64)
        for seed in seeds:
            lap = render(f"{world},sensors=rgbd,image=320x240,seed={seed}", every, keep)
            assert lap.truth is not None
            cells = [str(len(lap.images))]
            for number, (motion, in_order) in enumerate(product((None, poor_odometry(lap.poses, seed)), (False, True))):
                answers, eligible = own_past(lap, vocabulary, motion, in_order=in_order)
                same, unrelated = lap.truth.same_place() & eligible, lap.truth.unrelated()
                if number == 0:
                    cells += [str(int(part.any(axis=1).sum())) for part in (eligible, same)]
                if not in_order:
                    ranked = [[match.place for match in answer.matches] for answer in answers]
                    cells.append(f"{places_metrics.recall_at(ranked, same, 1):.3f}")
                counts = accepted(answers, same, unrelated)
                total[number] += counts
                cells.append(", ".join(str(count) for count in counts))
            print(f"| {world} {seed} | " + " | ".join(cells) + " |", flush=True)
        print(f"| {world} | right, beside, wrong: " + " | ".join(str(list(row)) for row in total.tolist()), flush=True)


def accepted(answers: Sequence[Answer], same: NDArray[np.bool_], unrelated: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Return how many accepted answers are right, beside the place, and wrong."""
    pairs = [(row, answer.matches[0].place) for row, answer in enumerate(answers) if answer.matches]
    pairs = [(row, place) for row, place in pairs if answers[row].matches[0].accepted]
    right = sum(bool(same[pair]) for pair in pairs)
    wrong = sum(bool(unrelated[pair]) for pair in pairs)
    return right, len(pairs) - right - wrong, wrong


def night(worlds: Sequence[str], seed: int, every: int, keep: Path | None, vocabulary: Vocabulary) -> None:
    print("| day, night | places, queries | votes @1 | @1 | @5 | accepted right, wrong | in order @1 | right, wrong |")
    print("|---|" + "---|" * 7)
    for world in worlds:
        by_day = f"trajectory={WORLDS[world].trajectory if world == 'road' else 'loop'},{DAY}"
        common = f"{world},sensors=mono,image=320x240,frames={WORLDS[world].frames},seed={seed}"
        day, dark = (render(f"{common},{condition}", every, keep) for condition in (by_day, NIGHT))
        distance = np.linalg.norm(dark.poses[:, None, :3, 3] - day.poses[None, :, :3, 3], axis=2)
        trace = np.einsum("aij,bij->ab", dark.poses[:, :3, :3], day.poses[:, :3, :3])
        angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
        truth = (distance <= NEAR_M) & (angle <= NEAR_DEG)
        far = (distance > 2 * NEAR_M) | (angle > 2 * NEAR_DEG)
        votes = [candidates[:1] for candidates in by_votes(day, dark, vocabulary)]
        cells = [f"{len(day.images)}, {len(dark.images)}", f"{places_metrics.recall_at(votes, truth, 1):.3f}"]
        for in_order in (False, True):
            answers = search(day.images, dark.images, vocabulary, VocabConfig(), top=20, in_order=in_order, workers=1)
            ranked = [[match.place for match in answer.matches] for answer in answers]
            cells += [f"{places_metrics.recall_at(ranked, truth, n):.3f}" for n in ((1,) if in_order else (1, 5))]
            right, _, wrong = accepted(answers, truth, far)
            cells.append(f"{right}, {wrong}")
        print(f"| {world} | " + " | ".join(cells) + " |", flush=True)


def by_votes(day: Lap, dark: Lap, vocabulary: Vocabulary) -> list[list[int]]:
    from seamark.vocab.place_index import PlaceIndex

    index = PlaceIndex(vocabulary, PLAIN_WORDS)
    for number, image in enumerate(day.images):
        index.add(image.observation(number, 0))
    return [[found.id for found in index.query(image.observation(-1, 1), 20).ranked] for image in dark.images]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("safety", "night"))
    parser.add_argument("worlds", nargs="+", choices=tuple(WORLDS))
    parser.add_argument("--seeds", type=int, default=3, help="how many, for safety")
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--every", type=int, default=10, help="frames from one image to the next")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.default()
    if options.what == "safety":
        seeds = range(options.first_seed, options.first_seed + options.seeds)
        safety(options.worlds, seeds, options.every, options.keep, vocabulary)
    else:
        night(options.worlds, options.first_seed, options.every, options.keep, vocabulary)


if __name__ == "__main__":
    main()
