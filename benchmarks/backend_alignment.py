"""Loops refined by depth images: errors before and after, honesty, what speaks against false loops, the map's error.

    .venv/bin/python benchmarks/backend_alignment.py office:0 twins:10 office_cheap:0 [--ate]
    .venv/bin/python benchmarks/backend_alignment.py DATA/tum_fr1_rpy DATA/rgbd_hololens [--ate]

NAME:SEED is a course of loop_courses.py, whose keyframes get the depth images of their rendered frames; anything else
is the path of a real RGB-D sequence with ground truth. Of a course the candidates of the place index are compared, of a
sequence pairs of keyframes that are near by the truth. Poses that every gate of features lets through are `true`
within 0.5 m and 10 degrees, else `false`; `lax` ones are those that only lenient gates let through.
NEES is per degree of freedom. ``--ate``: the RMSE of the map's keyframes with and without. One thread.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from backend_worlds import FALSE_DEG, FALSE_M, run
from loop_courses import Replay, coded, parts_of, replay, rig_of
from numpy.typing import NDArray

from seamark.backend.align_surfaces import Alignment, align, aligned
from seamark.backend.config import AlignmentConfig, BackendConfig, VerificationConfig
from seamark.backend.surfaces import surface_of
from seamark.backend.verify import Rejected, Verification, pair_seed, verify
from seamark.datasets_synth import sensor
from seamark.frontend import se3
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Keyframe, Mode
from seamark.service.sources.open import open_sources
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

LAX = VerificationConfig(
    min_matches=8,
    min_inliers=8,
    min_inlier_ratio=0.1,
    min_confirmed=0,
    min_explained=0,
    min_cells=2,
    min_hull_fraction=0.001,
    max_rotation_sigma_deg=10,
    max_translation_sigma_fraction=1,
)
CONFIG = FrontendConfig(keyframe_depth_px=160)
MOST_PAIRS = 250
NEAR_M, NEAR_DEG = 1.2, 40.0
HEAD = "| what | pose from | true loops | cm p50 / p95 | degrees p50 / p95 | NEES median / mean |"

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pair:
    query: Keyframe
    match: Keyframe
    kind: str
    found: Verification
    truth: Matrix

    def error(self, T: Matrix) -> NDArray[np.float64]:
        E = se3.inverse(self.truth) @ T
        return np.concatenate([se3.log_rotation(E[:3, :3]), E[:3, 3]])


def course(name: str) -> Replay:
    """Return a course whose keyframes carry depth."""
    world, seed = name.split(":")
    made, parts = replay(world, int(seed)), parts_of(world, int(seed))
    factor = rig_of(parts[0]).depth_factor
    frames = {f"{part.text}/{frame.index}": frame for part in parts for frame in coded(part)}
    keyframes = []
    for keyframe in made.keyframes:
        depth = sensor.decode(frames[keyframe.file], 0, keyframe.file).depth
        keyframes.append(replace(keyframe, depth=encode_depth(depth, factor, CONFIG)))
    return replace(made, keyframes=keyframes)


def sequence(path: str) -> Replay:
    """Return the keyframes of a real sequence with the true poses, interpolated."""
    source = open_sources([path], mode="rgbd")
    truth = source.ground_truth
    assert truth is not None
    frontend, keyframes = Frontend(source.rig, source.mode, CONFIG), []
    for frame in source.frames():
        keyframes += frontend.step(frame).keyframes
    keyframes += frontend.finish()
    stamps, poses = np.array(truth.stamps_ns), []
    for keyframe in keyframes:
        after = int(np.clip(np.searchsorted(stamps, keyframe.stamp_ns), 1, len(stamps) - 1))
        a, b = truth.T_world_cam[after - 1], truth.T_world_cam[after]
        u = float(np.clip((keyframe.stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1]), 0, 1))
        R = a[:3, :3] @ se3.exp_rotation(u * se3.log_rotation(a[:3, :3].T @ b[:3, :3]))
        poses.append(se3.make(R, (1 - u) * a[:3, 3] + u * b[:3, 3]))
    index, candidates = PlaceIndex(Vocabulary.default(), VocabConfig()), []
    for k in keyframes:
        seen = PlaceObservation(k.id, k.session, k.stamp_ns, k.features.descriptors, k.features.points, k.thumbnail)
        candidates.append(index.step(seen))
    return Replay(Path(path).name, Mode.RGBD, keyframes, candidates, np.array(poses))


def of_candidates(made: Replay) -> Iterator[tuple[int, int]]:
    for query, candidates in zip(made.keyframes, made.candidates, strict=True):
        tried: list[int] = []
        for candidate in candidates.ranked:
            near = any(abs(candidate.id - other) <= 3 for other in tried)
            if abs(candidate.id - query.id) >= 5 and not near and len(tried) < 5:
                tried.append(candidate.id)
                yield query.id, candidate.id


def of_neighbours(made: Replay) -> Iterator[tuple[int, int]]:
    T, order = made.T_world_cam, np.random.default_rng(0)
    count = len(T)
    pairs = [(q, m) for q in range(count) for m in range(q - 1)]
    for q, m in order.permutation(pairs).tolist():
        relative = se3.inverse(T[m]) @ T[q]
        turned = np.rad2deg(se3.rotation_angle(relative[:3, :3]))
        if np.linalg.norm(relative[:3, 3]) < NEAR_M and turned < NEAR_DEG:
            yield q, m


def pairs_of(made: Replay, numbers: Iterator[tuple[int, int]]) -> list[Pair]:
    pairs: list[Pair] = []
    for q, m in numbers:
        query, match = made.keyframes[q], made.keyframes[m]
        truth = se3.inverse(made.T_world_cam[m]) @ made.T_world_cam[q]
        for kind, config in (("", VerificationConfig()), ("lax ", LAX)):
            found = verify(query, match, config, pair_seed(1, q, m))
            if isinstance(found, Verification) and found.T_match_query is not None:
                pair = Pair(query, match, kind, found, truth)
                e = pair.error(found.T_match_query)
                wrong = np.linalg.norm(e[3:]) > FALSE_M or np.rad2deg(np.linalg.norm(e[:3])) > FALSE_DEG
                pairs.append(replace(pair, kind=kind + ("false" if wrong else "true")))
                break
        if len(pairs) >= MOST_PAIRS:
            break
    return pairs


def numbers_of(errors: list[NDArray[np.float64]], covariances: list[Matrix]) -> str:
    e = np.array(errors)
    cm, deg = 100 * np.linalg.norm(e[:, 3:], axis=1), np.rad2deg(np.linalg.norm(e[:, :3], axis=1))
    nees = [x @ np.linalg.solve(C, x) / 6 for x, C in zip(errors, covariances, strict=True)]
    shares = [f"{np.median(v):.2f} / {np.percentile(v, 95):.2f}" for v in (cm, deg)]
    return " | ".join([*shares, f"{np.median(nees):.2f} / {np.mean(nees):.2f}"])


def report(name: str, pairs: list[Pair], config: AlignmentConfig) -> None:
    by_kind: dict[str, list[tuple[Pair, Alignment]]] = defaultdict(list)
    spent = refused = kept = 0.0
    before, after = [], []
    for pair in pairs:
        T, C = pair.found.T_match_query, pair.found.covariance
        surfaces = surface_of(pair.query), surface_of(pair.match)
        if T is None or C is None or surfaces[0] is None or surfaces[1] is None:
            continue
        by_kind[pair.kind].append((pair, align(T, C, surfaces[0], surfaces[1], config)))
        if pair.kind != "true":
            continue
        started = time.process_time()
        result = aligned(pair.found, pair.query, pair.match, config)
        spent += time.process_time() - started
        before.append((pair.error(T), C))
        if isinstance(result, Rejected):
            refused += 1
        elif result.T_match_query is not None and result.covariance is not None:
            kept += result.T_match_query is T
            after.append((pair.error(result.T_match_query), result.covariance))
    count = max(1, len(before))
    for what, rows in (("features", before), ("and surfaces", after)):
        if rows:
            print(f"| {name} | {what} | {len(rows)} | {numbers_of(*map(list, zip(*rows, strict=True)))} |")
    size = np.median([len(pair.query.depth) for pair in pairs])
    print(
        f"  {1e3 * spent / count:.1f} ms CPU per loop, {size / 1024:.1f} kB per keyframe, {refused:.0f} true refused,"
        f" {kept:.0f} as they were"
    )
    for kind, found in sorted(by_kind.items()):
        through = np.array([alignment.through for _, alignment in found])
        shares = ", ".join(f"{limit}: {(through > limit).mean():.0%}" for limit in (0.05, 0.1, 0.25, 0.5))
        print(f"  {kind}: {len(found)}, more looked through than {shares}", flush=True)


def ate_table(made: Replay) -> None:
    for enabled in (False, True):
        done = run(made, BackendConfig(alignment=AlignmentConfig(enabled=enabled)))
        wrong = sum(judged.false for judged in done.judged)
        print(
            f"  surfaces {'on' if enabled else 'off'}: ATE {100 * done.ate_odometry_m:.2f} cm of odometry,"
            f" {100 * done.ate_m:.2f} of the map, {len(done.judged)} loops, {wrong} false, {done.cpu_s:.1f} s CPU",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--ate", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(HEAD + "\n" + "|---" * 6 + "|")
    for name in options.names:
        real = Path(name).exists()
        made = sequence(name) if real else course(name)
        choose: Callable[[Replay], Iterator[tuple[int, int]]] = of_neighbours if real else of_candidates
        report(made.name, pairs_of(made, choose(made)), AlignmentConfig())
        if options.ate:
            ate_table(made)


if __name__ == "__main__":
    main()
