"""Rotation and bearing of loops without depth, against the truth of rendered worlds.

    .venv/bin/python benchmarks/loop_directions.py twins office road dusk [--seeds 3]

Every keyframe is compared with its candidates within 2 m of it (``road``: 8 m), all depth being taken away, as a single
camera would. *Said*: places confirmed by epipolar geometry, and those of them whose views hold a direction. NEES per
degree of freedom, of the deviation in the worst direction: an honest one is below 1.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from backend_worlds import Matrix
from loop_courses import COURSES, replay

from seamark.backend.config import BackendConfig
from seamark.backend.verify import Verification, pair_seed, verify
from seamark.frontend import se3
from seamark.frontend.types import Keyframe
from seamark.vocab.vocabulary import Vocabulary

NEAR_M, NEAR_ON_ROAD_M, AHEAD_DEG = 2.0, 8.0, 60.0  # look-alike rooms are farther apart


def blind(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, landmarks=np.full((len(keyframe.features), 3), np.nan, np.float32))


def errors(course: str, seed: int, vocabulary: Vocabulary) -> tuple[int, list[Sequence[float]]]:
    """Return how many places were confirmed, and the errors (rad) of what was said with their deviations."""
    made, config = replay(course, seed, vocabulary=vocabulary), BackendConfig().verification
    confirmed, out, near = 0, [], NEAR_ON_ROAD_M if course == "road" else NEAR_M
    for query, candidates in zip(made.keyframes, made.candidates, strict=True):
        for candidate in candidates.ranked:
            true: Matrix = se3.inverse(made.T_world_cam[candidate.id]) @ made.T_world_cam[query.id]
            way = float(np.linalg.norm(true[:3, 3]))
            turned = np.rad2deg(se3.rotation_angle(true[:3, :3]))
            if candidate.id >= query.id - 5 or way > near or turned > AHEAD_DEG:
                continue
            pair = blind(query), blind(made.keyframes[candidate.id])
            found = verify(*pair, config, pair_seed(1, query.id, candidate.id))
            confirmed += isinstance(found, Verification)
            if isinstance(found, Verification) and found.direction is not None:
                said = found.direction
                turn = float(se3.rotation_angle(said.R_match_query.T @ true[:3, :3]))
                aside = float(np.arccos(np.clip(said.bearing @ true[:3, 3] / way, -1, 1)))
                out.append((turn, said.rotation_sigma, aside, said.bearing_sigma))
    return confirmed, out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("courses", nargs="+", choices=COURSES)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.default()
    print("| course | confirmed | said | turn deg p50 / p95 | NEES mean | bearing deg p50 / p95 | NEES mean |")
    print("|---|---|---|---|---|---|---|")
    for course in options.courses:
        found = [
            errors(course, seed, vocabulary) for seed in range(1 if course in ("dusk", "night") else options.seeds)
        ]
        turn, turn_sigma, aside, aside_sigma = np.array([row for _, rows in found for row in rows]).T
        cells = [course, str(sum(confirmed for confirmed, _ in found)), str(len(turn))]
        for error, sigma, freedom in ((turn, turn_sigma, 3), (aside, aside_sigma, 2)):
            cells.append("{:.2f} / {:.2f}".format(*np.rad2deg(np.percentile(error, (50, 95)))))
            cells.append(f"{np.mean((error / sigma) ** 2 / freedom):.2f}")
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
