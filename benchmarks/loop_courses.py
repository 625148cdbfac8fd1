"""Short rendered courses with true revisits, for benchmarks of the back end: at most 300 frames each.

A course is every third frame of a lap and, after it, a second traversal of its beginning (road: a second session), so
that true loops exist. What was rendered is kept under the cache folder, and what front end and vocabulary made of it
too, because the back end is what is measured. Rendering one course takes 5 to 10 s of CPU, its front end 6 to 10.

    nice .venv/bin/python benchmarks/loop_courses.py twins office road [--seeds 20]      # prepare all
"""

import argparse
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import sensor, specification, trajectory
from seamark.datasets_synth.rendering import render_some
from seamark.datasets_synth.scenario import default_cache_dir
from seamark.datasets_synth.sensor import CodedFrame
from seamark.frontend.camera import Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Frame, Keyframe, Mode
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

MOST_FRAMES = 300
VERSION = 2  # of what is kept below


@dataclass(frozen=True)
class Part:
    """Frames ``indices`` of a rendered sequence; ``fresh`` begins a session of its own."""

    text: str
    indices: range
    fresh: bool


@dataclass(frozen=True, eq=False)
class Replay:
    """What the back end is given, and the truth: ``T_world_cam`` (N, 4, 4) of each keyframe."""

    name: str
    mode: Mode
    keyframes: list[Keyframe]
    candidates: list[Candidates]
    T_world_cam: NDArray[np.float64]


DAYS = {"dusk": "condition=dusk,run=1", "night": "condition=night,run=2"}
COURSES = ("twins", "office", "road", "hall", "twins_apart", "office_apart", "office_cheap", *DAYS)


def parts_of(course: str, seed: int, image: str = "320x240") -> list[Part]:
    """Return what a course consists of.

    ``twins_apart`` and ``office_apart`` see one corridor (the rooms of one side) in a first session and its look-alike
    in a second one: nothing is seen twice, and no odometry speaks between them. ``dusk`` and ``night`` are 520 frames:
    the loop by day, and again aside in that light, with things moved. ``office_cheap`` has a distorting lens, and noise
    and warp of a cheap depth camera.
    """
    if course in DAYS:
        text = f"loop,frames=780,sensors=stereo,camera=real,image={image},seed={seed}"
        again = f"{text},trajectory=second_traversal,{DAYS[course]}"
        return [Part(f"{text},trajectory=loop", range(0, 780, 3), True), Part(again, range(0, 780, 3), True)]
    world = course.split("_")[0]
    sensors = "stereo" if world == "road" else "rgbd"
    text = f"{world},sensors={sensors},image={image},seed={seed}"
    if course.endswith("_cheap"):
        text = f"{text},sensor=cheap,camera=barrel"
    again = f"{text},trajectory=second_traversal"
    if world == "road":
        again = f"{again},run=1"
        return [Part(f"{text},trajectory=once", range(170), True), Part(again, range(130), True)]
    if world == "hall":
        return [Part(f"{text},trajectory=lawn_mower,frames=760", range(0, 760, 3), True)]
    wanted = specification.parse(text)
    lap = range(0, wanted.frames, 3)
    if course.endswith("_apart"):
        first, second = {"twins": ((0, 240), (380, 620)), "office": ((195, 400), (560, 750))}[world]
        return [Part(text, range(*first, 3), True), Part(text, range(*second, 3), True)]
    poses, second = wanted.poses(), specification.parse(f"{again},frames={wanted.frames}").poses()
    near = np.linalg.norm(second[: wanted.frames // 3, :3, 3] - poses[lap[-1], :3, 3], axis=1)
    begin = int(near.argmin()) + 3
    return [
        Part(text, lap, True),
        Part(f"{again},frames={wanted.frames}", range(begin, begin + 3 * (MOST_FRAMES - len(lap)), 3), False),
    ]


def kept_file(folder: str, name: str) -> Path:
    """Return where something that is dear to make is kept; its folder is there."""
    path = default_cache_dir() / folder / f"{name}.pickle"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def load_kept(path: Path) -> Any:
    try:
        return pickle.loads(path.read_bytes())
    except (OSError, EOFError, AttributeError, pickle.UnpicklingError):
        return None


def store_kept(path: Path, value: object) -> None:
    partial = path.with_suffix(".partial")
    partial.write_bytes(pickle.dumps(value))
    partial.rename(path)


def coded(part: Part) -> list[CodedFrame]:
    """Return the frames, rendered the first time."""
    wanted = specification.parse(part.text)
    path = kept_file(
        "courses", f"{specification.content_hash(wanted)}-{part.indices.start}-{part.indices.stop}-{part.indices.step}"
    )
    frames = load_kept(path)
    if frames is None:
        frames = list(render_some(wanted, list(part.indices)))
        store_kept(path, frames)
    return list(frames)


def frames_of(part: Part, start_ns: int) -> Iterator[Frame]:
    """Yield the frames with stamps from ``start_ns`` on."""
    stamps = trajectory.stamps(part.indices.stop, specification.FPS)
    for frame in coded(part):
        stamp_ns = start_ns + int(stamps[frame.index] - stamps[part.indices.start])
        yield sensor.decode(frame, stamp_ns, f"{part.text}/{frame.index}")


def rig_of(part: Part) -> Rig:
    return specification.parse(part.text).rig


def replay(
    course: str, seed: int, mode: Mode | None = None, image: str = "320x240", vocabulary: Vocabulary | None = None
) -> Replay:
    """Return the keyframes and candidates of a course; front end and vocabulary run the first time only."""
    world = course.split("_")[0]
    mode = mode or (Mode.STEREO if world == "road" or course in DAYS else Mode.RGBD)
    name = f"{course}-{seed}-{mode}-{image}"
    path = kept_file("replays", f"{name}-{VERSION}")
    found: Replay | None = load_kept(path)
    if found is None:
        found = _run(name, mode, parts_of(course, seed, image), vocabulary or Vocabulary.default())
        store_kept(path, found)
    return found


def _run(name: str, mode: Mode, parts: Sequence[Part], vocabulary: Vocabulary) -> Replay:
    keyframes: list[Keyframe] = []
    truth: list[NDArray[np.float64]] = []
    stamp_ns, sessions, frontend = 0, 0, None
    for part in parts:
        poses = specification.parse(part.text).poses()
        if part.fresh or frontend is None:
            frontend = Frontend(rig_of(part), mode, FrontendConfig())
            offset, sessions = len(keyframes), 1 + max((k.session for k in keyframes), default=-1)
        before = len(keyframes)
        for frame in frames_of(part, stamp_ns):
            keyframes += [_numbered(k, offset, sessions) for k in frontend.step(frame).keyframes]
            last_ns = frame.stamp_ns
        keyframes += [_numbered(k, offset, sessions) for k in frontend.finish()]
        truth += [poses[int(keyframe.file.rsplit("/", 1)[1])] for keyframe in keyframes[before:]]
        stamp_ns = last_ns + 3 * 10**9 // int(specification.FPS)
    index, candidates = PlaceIndex(vocabulary, VocabConfig()), []
    for k in keyframes:
        observation = PlaceObservation(
            k.id, k.session, k.stamp_ns, k.features.descriptors, k.features.points, k.thumbnail
        )
        candidates.append(index.step(observation))
    return Replay(name, mode, keyframes, candidates, np.array(truth))


def _numbered(keyframe: Keyframe, offset: int, sessions: int) -> Keyframe:
    """Return a keyframe of a later front end numbered after those of the earlier ones."""
    previous_id = None if keyframe.previous_id is None else keyframe.previous_id + offset
    return replace(keyframe, id=keyframe.id + offset, session=keyframe.session + sessions, previous_id=previous_id)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("courses", nargs="+", choices=COURSES)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--image", default="320x240")
    parser.add_argument("--mode", type=Mode)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.default()
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for course in options.courses:
            made = replay(course, seed, options.mode, options.image, vocabulary)
            sessions = len({keyframe.session for keyframe in made.keyframes})
            print(f"{made.name}: {len(made.keyframes)} keyframes, {sessions} sessions", flush=True)


if __name__ == "__main__":
    import loop_courses  # by its own name, so that other programs can read what it keeps

    loop_courses.main()
