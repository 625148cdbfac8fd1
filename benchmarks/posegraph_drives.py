"""Other drives for the acceptance of loops, made from KITTI 00 and 06: nothing was tuned on their false loops.

    .venv/bin/python benchmarks/posegraph_drives.py ../shared/data/posegraph_kitti [--seeds 2] [--keep 1.0 0.4]

Drives: reversed, mirrored, odometry errors doubled, blocks of another drive's real odometry errors, and generated city
blocks. False loops, 70 per cent of all: as those of the files (``file_random``, ``file_consistent``), and the harder
kinds of posegraph_files. ``--keep``: which share of the true loops is left. ``LM`` is GTSAM's on the true loops alone.
"""

import argparse
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import backend_posegraph as peers
import gtsam
import numpy as np
import posegraph_files as files

from seamark.backend.g2o import GraphFile
from seamark.frontend import se3

KINDS = ("file_random", "file_consistent", "near_groups", "mixed")
BLOCK = 200  # frames of odometry errors that stay together, so that their bias does


@dataclass(frozen=True, eq=False)
class Drive:
    """True poses (N, 4, 4), odometry's motions (N - 1, 4, 4) and true loops (from, to, T_from_to)."""

    truth: np.ndarray
    motions: np.ndarray
    loops: list
    covariances: tuple


def planar(turn, x, y):
    return se3.make(se3.exp_rotation(np.array([0, 0, turn])), np.array([x, y, 0]))


def components(T):
    return np.array([np.arctan2(T[1, 0], T[0, 0]), T[0, 3], T[1, 3]])


def load(folder):
    graph, truth = files.kitti(folder, "alpha_0.30")
    odometry = graph.to_ids == graph.from_ids + 1
    rows = np.flatnonzero(files.true_edges(graph, truth) & ~odometry)
    loops = [(int(graph.from_ids[k]), int(graph.to_ids[k]), graph.T_from_to[k]) for k in rows]
    return Drive(truth, graph.T_from_to[odometry], loops, (graph.covariances[0], graph.covariances[rows[0]]))


def backwards(drive):
    last = len(drive.truth) - 1
    loops = [(last - j, last - i, np.linalg.inv(T)) for i, j, T in drive.loops]
    return replace(drive, truth=drive.truth[::-1], motions=np.linalg.inv(drive.motions)[::-1], loops=loops)


def mirrored(drive):
    M = np.diag([1.0, -1, 1, 1])
    loops = [(i, j, M @ T @ M) for i, j, T in drive.loops]
    return replace(drive, truth=M @ drive.truth @ M, motions=M @ drive.motions @ M, loops=loops)


def odometry_errors(drive):
    true = np.linalg.inv(drive.truth[:-1]) @ drive.truth[1:]
    return np.array([components(E) for E in np.linalg.inv(true) @ drive.motions])


def with_errors(drive, errors):
    true = np.linalg.inv(drive.truth[:-1]) @ drive.truth[1:]
    return replace(drive, motions=np.array([T @ planar(*e) for T, e in zip(true, errors, strict=True)]))


def borrowed(drive, source, rng):
    """Give a drive blocks of another one's real odometry errors, mirrored at random."""
    errors, out = odometry_errors(source), []
    while len(out) < len(drive.motions):
        first = int(rng.integers(0, len(errors) - BLOCK))
        out += list(errors[first : first + BLOCK] * np.array([sign := rng.choice([-1, 1]), 1, sign]))
    return with_errors(drive, out[: len(drive.motions)])


def city(source, rng, blocks, length, metres):
    """Drive through city blocks at 0.9 m a frame; a third of what every fifth frame sees again becomes a loop."""
    directions = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    corner, heading = np.array([blocks // 2, blocks // 2]), 0
    corners = [corner * length]
    while len(corners) * length < metres:
        corner = corner + directions[heading]
        corners.append(corner * length)
        ways = [(heading + turn) % 4 for turn in (-1, 0, 1)]
        ways = [w for w in ways if ((corner + directions[w]) >= 0).all() and ((corner + directions[w]) <= blocks).all()]
        heading = int(rng.choice(ways))
    along = np.arange(0, (len(corners) - 1) * length, 0.9)
    path = [np.interp(along, np.arange(len(corners)) * length, axis) for axis in np.array(corners, float).T]
    path = [np.convolve(np.pad(axis, 6, "edge"), np.ones(13) / 13, "valid") for axis in path]  # round the corners
    path = np.stack(path, axis=1) + rng.normal(0, 0.3, 2)
    tangent = np.gradient(path, axis=0)
    truth = np.array([planar(np.arctan2(t[1], t[0]), *p) for t, p in zip(tangent, path, strict=True)])
    errors = [components(se3.inverse(se3.inverse(source.truth[i]) @ source.truth[j]) @ T) for i, j, T in source.loops]
    loops = []
    for j in range(0, len(truth), 5):
        near = np.flatnonzero(np.linalg.norm(truth[: max(0, j - 100), :2, 3] - truth[j, :2, 3], axis=1) < 3)
        near = [i for i in near if abs(components(se3.inverse(truth[i]) @ truth[j])[0]) < 0.5]
        if near and rng.random() < 0.35:
            i = int(rng.choice(near))
            loops.append((i, j, se3.inverse(truth[i]) @ truth[j] @ planar(*errors[rng.integers(len(errors))])))
    return borrowed(Drive(truth, np.linalg.inv(truth[:-1]) @ truth[1:], loops, source.covariances), source, rng)


def drives(root):
    k00, k06, rng = load(root / "00"), load(root / "06"), np.random.default_rng(5)
    return {
        "00": k00,
        "06": k06,
        "06 backwards in a mirror": mirrored(backwards(k06)),
        "00, errors doubled": with_errors(k00, 2 * odometry_errors(k00)),
        "06, errors of 00": borrowed(k06, k00, rng),
        "city, 90 m blocks": city(k00, np.random.default_rng(1), 3, 90.0, 2200.0),
        "city, 120 m blocks": city(k00, np.random.default_rng(2), 3, 120.0, 3000.0),
    }


def false_loops(kind, count, truth, rng):
    """Return wrong loops as the given files have them: any pose, or a wrong place seen for 4 to 9 nodes."""
    if not kind.startswith("file"):
        return files.false_loops(kind, count, truth, rng)
    out = []
    while len(out) < count:
        m, q = sorted(int(x) for x in rng.integers(0, len(truth) - 40, 2))
        if q - m < 100 or np.linalg.norm(truth[q, :3, 3] - truth[m, :3, 3]) < 20:
            continue
        if kind == "file_random":
            out.append((m, q, planar(rng.uniform(-np.pi, np.pi), *rng.uniform(-10, 10, 2))))
            continue
        base = planar(rng.normal(0, 0.1), *rng.normal(0, 1, 2))
        for k in range(0, 3 * int(rng.integers(4, 10)), 3):
            T = se3.inverse(truth[m + k]) @ truth[m] @ base @ se3.inverse(truth[q]) @ truth[q + k]
            out.append((m + k, q + k, T @ planar(rng.normal(0, 0.01), *rng.normal(0, 0.1, 2))))
    return out[:count]


def graph_of(drive, kind, seed, keep):
    """Return the graph with false loops and which those are."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(drive.loops), max(3, round(keep * len(drive.loops))), replace=False)
    loops = {drive.loops[k][:2]: drive.loops[k] for k in sorted(chosen)}
    kinds = ("file_random", "file_consistent", "near_groups", "long_groups") if kind == "mixed" else (kind,)
    count = int(len(drive.loops) * 7 / 3) // len(kinds)
    false = {x[:2]: x for each in kinds for x in false_loops(each, count, drive.truth, rng) if x[:2] not in loops}
    edges, steps = [*loops.values(), *false.values()], np.arange(len(drive.truth) - 1)
    return GraphFile(
        planar=True,
        node_ids=np.arange(len(drive.truth)),
        T_vertex=np.full((len(drive.truth), 4, 4), np.nan),
        from_ids=np.concatenate([steps, [x[0] for x in edges]]),
        to_ids=np.concatenate([steps + 1, [x[1] for x in edges]]),
        T_from_to=np.concatenate([drive.motions, np.stack([x[2] for x in edges])]),
        covariances=np.repeat(np.stack(drive.covariances), [len(steps), len(edges)], axis=0),
        ignored={},
    ), set(false)


def true_alone(graph, false, truth):
    """Return the ATE of GTSAM's LM with the true loops, robust against their own larger errors."""
    factors, values, _ = peers.peer_graph(peers.without(graph, false), gtsam.noiseModel.mEstimator.Cauchy.Create(3.0))
    positions = gtsam.utilities.extractPose2(gtsam.LevenbergMarquardtOptimizer(factors, values).optimize())
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :2, 3] = positions[:, :2]
    return files.ate(T, truth)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--keep", type=float, nargs="*", default=[1.0, 0.4])
    arguments = parser.parse_args()
    runs, worse, kept_false = Counter(), Counter(), Counter()
    for name, drive in drives(arguments.folder).items():
        for kind, keep, seed in ((k, p, s) for k in KINDS for p in arguments.keep for s in range(arguments.seeds)):
            graph, false = graph_of(drive, kind, seed, keep)
            alone, row = true_alone(graph, false, drive.truth), peers.ours(graph, false, drive.truth, live=False)
            print(f"{name}, {kind}, {keep:.0%} of the true loops, seed {seed}: LM on the true ones {alone:.2f} m")
            peers.show("batch", row)
            runs[kind, keep] += 1
            worse[kind, keep] += row["ate"] > 1.05 * alone
            kept_false[kind, keep] += row["false"]
    for case in runs:
        print(f"{case[0]}, {case[1]:.0%}: {worse[case]} of {runs[case]} worse by 5 %, false kept {kept_false[case]}")


if __name__ == "__main__":
    main()
