"""Loops on rendered worlds against the truth: false ones, errors, honesty of covariances, injected false loops.

    .venv/bin/python benchmarks/backend_worlds.py safety twins office road [--seeds 20] [--mode mono]
    .venv/bin/python benchmarks/backend_worlds.py inject twins office road [--seeds 5]

``safety`` counts committed loops whose pose is wrong (by more than 0.5 m or 10 degrees), says how many keyframes that
see a place again have a right loop, and the ATE with and without loops. ``inject`` adds false verified loops until
they are 10, 30 and 50 per cent of all: random ones, and groups that agree with each other, as if another place were
seen for several keyframes. Errors and NEES are of the relative poses of accepted loops. Courses: loop_courses.py.
"""

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from loop_courses import COURSES, Replay, replay
from numpy.typing import NDArray

from seamark.backend.config import BackendConfig
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.slam import Slam
from seamark.backend.types import Loop, MapSnapshot
from seamark.backend.verify import Verification
from seamark.backend.verify_candidates import Verified
from seamark.frontend import se3
from seamark.frontend.types import Keyframe, Mode
from seamark.vocab.types import Candidate, Candidates
from seamark.vocab.vocabulary import Vocabulary

FALSE_M, FALSE_DEG = 0.5, 10.0
GROUP = 4  # injected loops that agree with each other

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """An accepted loop against the truth: errors of its pose and its NEES per degree of freedom."""

    loop: Loop
    error_m: float
    error_deg: float
    nees: float
    rotation_nees: float
    translation_nees: float

    @property
    def false(self) -> bool:
        return self.error_m > FALSE_M or self.error_deg > FALSE_DEG


@dataclass(frozen=True, eq=False)
class Run:
    """One course through the back end."""

    name: str
    keyframes: int
    judged: list[Judged]
    reasons: Counter[str]
    revisits: int
    revisits_closed: int
    ate_odometry_m: float
    ate_m: float
    sessions: int
    components: int
    cpu_s: float


class InjectedSlam(Slam):
    """Adds to the verified loops of each keyframe those that ``injected`` has for it."""

    injected: dict[int, Verified]

    def _verify(self, keyframe: Keyframe, candidates: Candidates) -> Verified:
        own = super()._verify(keyframe, candidates)
        taken = {candidate.id for candidate, _ in own}
        return own + [pair for pair in self.injected.get(keyframe.id, []) if pair[0].id not in taken]


def judge(loop: Loop, T_world_cam: Matrix) -> Judged:
    assert loop.T_match_query is not None and loop.covariance is not None
    true = se3.inverse(T_world_cam[loop.match_id]) @ T_world_cam[loop.query_id]
    E = se3.inverse(true) @ loop.T_match_query
    error = np.concatenate([se3.log_rotation(E[:3, :3]), E[:3, 3]])
    C = loop.covariance
    nees = [float(error[s] @ np.linalg.solve(C[s, s], error[s])) for s in (slice(6), slice(3), slice(3, 6))]
    degrees = float(np.rad2deg(np.linalg.norm(error[:3])))
    return Judged(loop, float(np.linalg.norm(error[3:])), degrees, nees[0] / 6, nees[1] / 3, nees[2] / 3)


def revisits(made: Replay) -> NDArray[np.bool_]:
    """Return which keyframes (N,) look within 1 m and 20 degrees at what one at least 10 before them saw."""
    T = made.T_world_cam
    distance = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=2)
    cosine = (np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3]) - 1) / 2
    near = (distance < 1.0 if "road" not in made.name else distance < 5.0) & (cosine > np.cos(np.deg2rad(20)))
    rows, columns = np.indices(near.shape)
    session = np.array([keyframe.session for keyframe in made.keyframes])
    return np.asarray((near & ((rows - columns >= 10) | (session[rows] > session[columns]))).any(axis=1))


def ate(T: Matrix, truth: Matrix, scaled: bool) -> float:
    """Return the RMSE (m) of positions after the best rigid (or similarity) alignment (Umeyama 1991)."""
    a, b = T[:, :3, 3], truth[:, :3, 3]
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    U, D, Vt = np.linalg.svd(b0.T @ a0)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    scale = (D * sign).sum() / (a0**2).sum() if scaled else 1.0
    return float(np.sqrt(((b0 - scale * a0 @ (U * sign @ Vt).T) ** 2).sum(axis=1).mean()))


def ate_by_group(T: Matrix, truth: Matrix, groups: NDArray[np.int64], scaled: bool) -> float:
    """Return the RMSE over all groups of at least five keyframes, each aligned on its own."""
    parts = [groups == group for group in np.unique(groups)]
    counts = [int(part.sum()) for part in parts if part.sum() >= 5]
    errors = [ate(T[part], truth[part], scaled) for part in parts if part.sum() >= 5]
    return float(np.sqrt(np.average(np.square(errors), weights=counts))) if errors else float("nan")


def run(made: Replay, config: BackendConfig, injected: dict[int, Verified] | None = None) -> Run:
    begun = time.process_time()
    slam = InjectedSlam(config, made.mode, PoseGraph(config), 1)
    slam.injected = injected or {}
    for keyframe, candidates in zip(made.keyframes, made.candidates, strict=True):
        slam.step(keyframe, candidates)
    slam.finish()
    cpu_s = time.process_time() - begun
    snapshot, scaled = slam.snapshot(), made.mode is Mode.MONO
    accepted = [loop for loop in snapshot.loops if loop.accepted]
    judged = [judge(unscaled(loop, made, snapshot), made.T_world_cam) for loop in accepted]
    again = revisits(made)
    closed = {j.loop.query_id for j in judged if not j.false}
    odometry = np.array([k.T_odom_cam for k in made.keyframes])
    sessions = np.array([k.session for k in made.keyframes])
    return Run(
        made.name,
        len(made.keyframes),
        judged,
        Counter(str(loop.reason) for loop in snapshot.loops),
        int(again.sum()),
        sum(bool(again[number]) for number in closed),
        ate_by_group(odometry, made.T_world_cam, sessions, scaled),
        ate_by_group(snapshot.T_map_cam, made.T_world_cam, snapshot.components, scaled),
        len(set(sessions.tolist())),
        len(set(snapshot.components.tolist())),
        cpu_s,
    )


def unscaled(loop: Loop, made: Replay, snapshot: MapSnapshot) -> Loop:
    """Return the loop in metres: mono sessions have a unit of their own, known from the truth."""
    if made.mode is not Mode.MONO:
        return loop
    assert loop.T_match_query is not None and loop.covariance is not None
    units = [unit_near(made, number) for number in (loop.match_id, loop.query_id)]
    T, C = loop.T_match_query.copy(), loop.covariance.copy()
    T[:3, 3] *= units[0]
    C[3:, :] *= units[1]
    C[:, 3:] *= units[1]
    return replace(loop, T_match_query=T, covariance=C)


def unit_near(made: Replay, keyframe_id: int) -> float:
    """Return metres per unit of a mono session about a keyframe."""
    session = made.keyframes[keyframe_id].session
    ids = [k.id for k in made.keyframes if k.session == session and abs(k.id - keyframe_id) <= 4]
    true = np.linalg.norm(np.diff(made.T_world_cam[ids, :3, 3], axis=0), axis=1).sum()
    odometry = np.array([made.keyframes[number].T_odom_cam for number in ids])
    return float(true / max(np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1).sum(), 1e-9))


def false_loops(made: Replay, clean: Run, share: float, consistent: bool, seed: int) -> dict[int, Verified]:
    """Return false verified loops so that they are ``share`` of all that the clean run has accepted and these.

    Random ones have the pose of any two keyframes; consistent ones put ``GROUP`` neighbouring keyframes, as a whole,
    at another place: the relative pose that a displaced but otherwise right view would have.
    """
    rng = np.random.default_rng([seed, int(100 * share), consistent])
    pool = [j.loop for j in clean.judged if not j.false]
    wanted, count = round(share / (1 - share) * len(pool)), len(made.keyframes)
    out: dict[int, Verified] = {}
    added = 0
    while added < wanted and count > 20:
        first = int(rng.integers(12, count))
        target = int(rng.integers(0, first - 10))
        about = se3.make(se3.exp_rotation(rng.normal(0, 0.15, 3)), rng.normal(0, 0.4, 3))
        G = made.T_world_cam[target] @ about @ se3.inverse(made.T_world_cam[first])
        for step in range(GROUP if consistent else 1):
            query, match = first + step, target + step
            if query >= count or added >= wanted:
                break
            if any(candidate.id == match for candidate, _ in out.get(query, [])):
                continue
            like = pool[int(rng.integers(len(pool)))]
            noise = rng.multivariate_normal(np.zeros(6), like.covariance)
            T = se3.inverse(made.T_world_cam[match]) @ G @ made.T_world_cam[query]
            T = T @ se3.make(se3.exp_rotation(noise[:3]), noise[3:])
            result = Verification(like.inliers, 2 * like.inliers, T, like.covariance)
            out.setdefault(query, []).append((Candidate(match, 0.5, 0.5, 0.1), result))
            added += 1
    return out


def row(runs: Sequence[Run]) -> str:
    judged = [j for run in runs for j in run.judged]
    right = [j for j in judged if not j.false]
    reasons: Counter[str] = sum((run.reasons for run in runs), Counter())
    errors = np.array([[100 * j.error_m, j.error_deg, j.nees] for j in right]).reshape(-1, 3)
    cells = [
        str(len(runs)),
        str(sum(run.keyframes for run in runs)),
        f"{len(right)}",
        f"**{len(judged) - len(right)}**",
    ]
    cells.append(f"{sum(run.revisits_closed for run in runs)} of {sum(run.revisits for run in runs)}")
    cells.append(f"{sum(run.components < run.sessions for run in runs)} of {sum(run.sessions > 1 for run in runs)}")
    ates = np.array([[run.ate_odometry_m, run.ate_m] for run in runs])
    cells.append("{:.3f} / {:.3f}".format(*np.median(ates, axis=0)))
    if len(right):
        cells.append("{:.1f} / {:.1f}".format(*np.percentile(errors[:, 0], (50, 95))))
        cells.append("{:.2f} / {:.2f}".format(*np.percentile(errors[:, 1], (50, 95))))
        cells.append(f"{np.median(errors[:, 2]):.2f} / {errors[:, 2].mean():.2f}")
    else:
        cells += ["-"] * 3
    cells.append(", ".join(f"{name} {number}" for name, number in reasons.most_common()))
    return " | ".join(cells)


HEAD = (
    "| course | runs | keyframes | right | false | revisits closed | joined | ATE m odometry / map "
    "| error cm p50 / p95 | deg p50 / p95 | NEES median / mean | verdicts |"
)


def safety(courses: Sequence[str], seeds: Sequence[int], mode: Mode | None, image: str) -> None:
    print(HEAD)
    print("|---" * HEAD.count(" | ") + "|---|")
    vocabulary = Vocabulary.default()
    for course in courses:
        runs = [run(replay(course, seed, mode, image, vocabulary), BackendConfig()) for seed in seeds]
        print(f"| {course} {mode or ''} | {row(runs)} |", flush=True)
        for each in runs:
            for j in each.judged:
                if j.false:
                    where = f"{j.loop.query_id} to {j.loop.match_id}, {j.loop.inliers} inliers"
                    print(f"  false: {each.name}: {where}, off by {j.error_m:.2f} m, {j.error_deg:.1f} deg", flush=True)


def inject(courses: Sequence[str], seeds: Sequence[int], mode: Mode | None, image: str) -> None:
    print("| course, seed | false | kind | injected | accepted of these | ATE m clean / with | ratio |")
    print("|---|---|---|---|---|---|---|")
    for course in courses:
        for seed in seeds:
            made = replay(course, seed, mode, image)
            clean = run(made, BackendConfig())
            for share in (0.1, 0.3, 0.5):
                for consistent in (False, True):
                    injected = false_loops(made, clean, share, consistent, seed)
                    dirty = run(made, BackendConfig(), injected)
                    pairs = {(query, pair[0].id) for query, pairs in injected.items() for pair in pairs}
                    taken = sum(j.false and (j.loop.query_id, j.loop.match_id) in pairs for j in dirty.judged)
                    cells = [
                        f"{course} {seed}",
                        f"{share:.0%}",
                        "consistent" if consistent else "random",
                        str(len(pairs)),
                    ]
                    cells += [str(taken), f"{clean.ate_m:.3f} / {dirty.ate_m:.3f}", f"{dirty.ate_m / clean.ate_m:.2f}"]
                    print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("safety", "inject"))
    parser.add_argument("courses", nargs="+", choices=COURSES)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--mode", type=Mode)
    parser.add_argument("--image", default="320x240")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    {"safety": safety, "inject": inject}[options.what](options.courses, seeds, options.mode, options.image)


if __name__ == "__main__":
    main()
