"""Places on rendered worlds: is a wrong place ever accepted, and what is left of recall at night?

    .venv/bin/python benchmarks/places_rendered.py safety twins office road [--seeds 20] [--first-seed 0] [--list]
    .venv/bin/python benchmarks/places_rendered.py night loop street road [--first-seed 100]

``safety`` asks each of the 300 frames of a course (loop_courses.py) for places in its own past, by looks alone and with
the odometry of the front end as ``seamark places eval`` has it, each frame alone and in order. Two images show one
place when they share a quarter of the surface that they see (ground_truth.PlaceTruth); an accepted answer is wrong when
they share at most 2 per cent, and beside the place in between. ``--list`` names what odometry did not prevent.
``night`` asks a night traverse with a cheap camera, aside and looking aside, for places of the day; an answer is right
within 3 m and 45 degrees. Pictures are 320 x 240. What was rendered and described is kept under the cache folder.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from loop_courses import Part, frames_of, kept_file, load_kept, parts_of, rig_of, store_kept
from numpy.typing import NDArray

from seamark.datasets_synth import sensor, specification, trajectory
from seamark.datasets_synth.ground_truth import PlaceTruth, place_truth
from seamark.datasets_synth.rendering import render_some
from seamark.datasets_synth.worlds import WORLDS
from seamark.frontend.camera import Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.types import Frame, Mode
from seamark.service import places_metrics
from seamark.service.places_images import DescribedImage, describe_image
from seamark.service.places_motion import Motion, motion_of
from seamark.service.places_search import Answer, search, search_own
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary

DAY = "camera=real,condition=day"
NIGHT = "camera=real,condition=night,run=2,trajectory=second_traversal,sensor=cheap"
PLAIN_WORDS = VocabConfig(histogram_weight=0.0, view_weight=0.0)
NEAR_M, NEAR_DEG = 3.0, 45.0
VERSION = 1  # of what is kept of courses


@dataclass(frozen=True, eq=False)
class Lap:
    """What was rendered: images, their stamps (N,), poses (N, 4, 4); of a course which share surface, and odometry."""

    images: list[DescribedImage]
    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    truth: PlaceTruth | None = None
    motion: Motion | None = None


def lap(text: str, every: int) -> Lap:
    """Return every so many frames of a rendered sequence."""
    path = kept_file("places", f"{text}-{every}")
    found = load_kept(path)
    if found is None:
        wanted, config = specification.parse(text), FrontendConfig()
        indices = list(range(0, wanted.frames, every))
        frames = (sensor.decode(coded, 0, "") for coded in render_some(wanted, indices))
        images = [describe_image(frame.image, str(frame.index), config) for frame in frames]
        found = Lap(images, trajectory.stamps(wanted.frames, specification.FPS)[indices], wanted.poses()[indices])
        store_kept(path, found)
    assert isinstance(found, Lap)
    return found


def course(name: str, seed: int) -> Lap:
    """Return a course with the odometry of the front end and the truth of rendered depth."""
    path = kept_file("places", f"{name}-{seed}-{VERSION}")
    found = load_kept(path)
    if found is None:
        found = _follow_course(parts_of(name, seed))
        store_kept(path, found)
    assert isinstance(found, Lap)
    return found


def _follow_course(parts: Sequence[Part]) -> Lap:
    runs: list[list[Part]] = []  # parts that one front end follows
    for part in parts:
        if part.fresh:
            runs.append([])
        runs[-1].append(part)
    images: list[DescribedImage] = []
    poses, depths, motions = [], [], []
    stamps_ns: list[int] = []
    config = FrontendConfig()
    for run in runs:
        frames = []
        for part in run:
            start_ns = stamps_ns[-1] + 3 * 10**9 // int(specification.FPS) if stamps_ns else 0
            more = list(frames_of(part, start_ns))
            stamps_ns += [frame.stamp_ns for frame in more]
            frames += more
            poses.append(specification.parse(part.text).poses()[list(part.indices)])
            seen = replace(part, text=part.text.replace("sensors=stereo", "sensors=rgbd"))  # stereo has no depth
            depths += [depth_of(frame, rig_of(seen)) for frame in frames_of(seen, 0)]
        images += [describe_image(frame.image, frame.file, config) for frame in frames]
        mode = Mode.RGBD if frames[0].depth is not None else Mode.STEREO
        motions.append(motion_of(frames, len(frames), rig_of(run[0]), mode, config))
    sessions = [np.where(m.sessions < 0, m.sessions, m.sessions + 1000 * n) for n, m in enumerate(motions)]
    motion = Motion(np.concatenate([m.T_odom_cam for m in motions]), np.concatenate(sessions), metric=True)
    truth = place_truth(depths, np.concatenate(poses), rig_of(parts[0]).cam0)
    return Lap(images, np.array(stamps_ns), np.concatenate(poses), truth, motion)


def depth_of(frame: Frame, rig: Rig) -> NDArray[np.float32]:
    assert frame.depth is not None and rig.depth_factor is not None
    return np.asarray(frame.depth, np.float32) / rig.depth_factor


def own_past(
    made: Lap, vocabulary: Vocabulary, motion: Motion | None, *, in_order: bool
) -> tuple[list[Answer], NDArray[np.bool_]]:
    stamps = made.stamps_ns.tolist()
    return search_own(
        made.images, stamps, vocabulary, VocabConfig(), top=20, in_order=in_order, workers=1, motion=motion
    )


def safety(worlds: Sequence[str], seeds: Sequence[int], vocabulary: Vocabulary, *, named: bool) -> None:
    print("| | images | asked | with a place | looks: @1 | accepted | in order | odometry: @1 | accepted | in order |")
    print("|---|" + "---|" * 9 + "  (accepted: right, beside, wrong)")
    for world in worlds:
        total = np.zeros((4, 3), np.int64)
        for seed in seeds:
            made = course(world, seed)
            assert made.truth is not None and made.motion is not None
            cells = [str(len(made.images))]
            for number, (motion, in_order) in enumerate(product((None, made.motion), (False, True))):
                answers, eligible = own_past(made, vocabulary, motion, in_order=in_order)
                same, unrelated = made.truth.same_place() & eligible, made.truth.unrelated()
                if number == 0:
                    cells += [str(int(part.any(axis=1).sum())) for part in (eligible, same)]
                if not in_order:
                    ranked = [[match.place for match in answer.matches] for answer in answers]
                    cells.append(f"{places_metrics.recall_at(ranked, same, 1):.3f}")
                counts = accepted(answers, same, unrelated)
                total[number] += counts
                cells.append(", ".join(str(count) for count in counts))
                if named and motion is not None and counts[2]:
                    _name_wrong(made, answers, unrelated, in_order)
            print(f"| {world} {seed} | " + " | ".join(cells) + " |", flush=True)
        print(f"| {world} | right, beside, wrong: " + " | ".join(str(list(row)) for row in total.tolist()), flush=True)


def _name_wrong(made: Lap, answers: Sequence[Answer], unrelated: NDArray[np.bool_], in_order: bool) -> None:
    for row, answer in enumerate(answers):
        if answer.matches and answer.matches[0].accepted and unrelated[row, answer.matches[0].place]:
            match = answer.matches[0]
            apart = np.linalg.norm(made.poses[row, :3, 3] - made.poses[match.place, :3, 3])
            cosine = (np.trace(made.poses[row, :3, :3].T @ made.poses[match.place, :3, :3]) - 1) / 2
            turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            print(
                f"  wrong, in order {in_order}: {made.images[row].name} as {made.images[match.place].name}, "
                f"{match.inliers} inliers, p {answer.probability:.3f}, {apart:.2f} m and {turned:.0f} degrees apart"
            )


def accepted(answers: Sequence[Answer], same: NDArray[np.bool_], unrelated: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Return how many accepted answers are right, beside the place, and wrong."""
    pairs = [(row, answer.matches[0].place) for row, answer in enumerate(answers) if answer.matches]
    pairs = [(row, place) for row, place in pairs if answers[row].matches[0].accepted]
    right = sum(bool(same[pair]) for pair in pairs)
    wrong = sum(bool(unrelated[pair]) for pair in pairs)
    return right, len(pairs) - right - wrong, wrong


def night(worlds: Sequence[str], seed: int, every: int, vocabulary: Vocabulary) -> None:
    print("| day, night | places, queries | votes @1 | @1 | @5 | accepted right, wrong | in order @1 | right, wrong |")
    print("|---|" + "---|" * 7)
    for world in worlds:
        by_day = f"trajectory={WORLDS[world].trajectory if world == 'road' else 'loop'},{DAY}"
        common = f"{world},sensors=mono,image=320x240,frames={WORLDS[world].frames},seed={seed}"
        day, dark = (lap(f"{common},{condition}", every) for condition in (by_day, NIGHT))
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
    parser.add_argument("--seeds", type=int, default=20, help="how many, for safety")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=10, help="frames from one image of a night to the next")
    parser.add_argument("--list", action="store_true", help="name the wrong answers that odometry did not prevent")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.default()
    if options.what == "safety":
        seeds = range(options.first_seed, options.first_seed + options.seeds)
        safety(options.worlds, seeds, vocabulary, named=options.list)
    else:
        night(options.worlds, options.first_seed, options.every, vocabulary)


if __name__ == "__main__":
    main()
