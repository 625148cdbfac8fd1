"""Robustness of the back end on real driving graphs (KITTI 00 and 06) whose loops are false to some 70 per cent.

    .venv/bin/python benchmarks/backend_posegraph.py ../shared/data/posegraph_kitti [00 06] [--peers]
    .venv/bin/python benchmarks/backend_posegraph.py ../shared/data/posegraph_kitti 00 06 --seeds 5

Prints per graph and method: true and false loops kept, ATE in m after SE(3) alignment, CPU seconds. ``true alone``:
what is made of the true loops. ``standing``: for how many nodes a false loop that was withdrawn in the end stood
at most; for those never withdrawn a plus. ``--peers`` adds what GTSAM offers, on Pose2, with noise chosen by hand
(odometry 0.05 m and 0.005 rad, loops 0.3 m and 0.03 rad), which the methods here have to estimate. ``--seeds`` replaces
the false loops by seeded ones of seven kinds, in the plane and, for ``--spatial``, on hills.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import posegraph_files as files

from seamark.backend.graph_solve import solve_graph

ODOMETRY_SIGMAS = np.array([0.05, 0.05, 0.005])
LOOP_SIGMAS = np.array([0.3, 0.3, 0.03])


def without(graph, false):
    """Return the graph without these pairs."""
    rows = [
        k
        for k, pair in enumerate(zip(graph.from_ids.tolist(), graph.to_ids.tolist(), strict=True))
        if pair not in false
    ]
    columns = ("from_ids", "to_ids", "T_from_to", "covariances")
    return replace(graph, **{name: getattr(graph, name)[rows] for name in columns})


def ours(graph, false, truth, live):
    """Return a row of the table."""
    started = time.process_time()
    solution = solve_graph(graph, live)
    seconds = time.process_time() - started
    is_false = np.array([(loop.from_id, loop.to_id) in false for loop in solution.loops], bool)
    kept = np.array([loop.kept for loop in solution.loops], bool)
    stood = [loop for loop, wrong in zip(solution.loops, is_false, strict=True) if wrong and loop.added_at is not None]
    standing = max((loop.withdrawn_at - loop.added_at for loop in stood if not loop.kept), default=0)
    return {
        "true": int((kept & ~is_false).sum()),
        "false": int((kept & is_false).sum()),
        "ate": files.ate(solution.estimate.T_map_cam, truth),
        "cpu_s": seconds,
        "standing": f"{standing}{'+' if any(loop.kept for loop in stood) else ''}",
    }


def peer_graph(graph, robust):
    """Return GTSAM's graph, initial values from odometry, and which factors are loops."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    odometry_noise = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY_SIGMAS)
    loop_noise = gtsam.noiseModel.Diagonal.Sigmas(LOOP_SIGMAS)
    if robust is not None:
        loop_noise = gtsam.noiseModel.Robust.Create(robust, loop_noise)
    loops = []
    pose = gtsam.Pose2()
    values.insert(0, pose)
    factors.add(gtsam.PriorFactorPose2(0, pose, gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
    for i, j, T in zip(graph.from_ids.tolist(), graph.to_ids.tolist(), graph.T_from_to, strict=True):
        motion = gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))
        is_loop = j != i + 1
        if is_loop:
            loops.append(factors.size())
        else:
            pose = pose.compose(motion)
            values.insert(j, pose)
        factors.add(gtsam.BetweenFactorPose2(i, j, motion, loop_noise if is_loop else odometry_noise))
    return factors, values, loops


def isam2(factors, values):
    """Return the last estimate of iSAM2 that is fed with the graph node by node."""
    by_key = {}
    for k in range(factors.size()):
        by_key.setdefault(max(factors.at(k).keys()), []).append(k)
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    for key in sorted(by_key):
        new, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in by_key[key]:
            new.add(factors.at(k))
        initial.insert(key, values.atPose2(key))
        isam.update(new, initial)
    return isam.calculateEstimate()


def peers(graph, false, truth):
    """Yield name and row of each method that GTSAM offers."""
    m = gtsam.noiseModel.mEstimator
    kernels = {"LM": None, "iSAM2": None, "Huber": m.Huber.Create(1.345), "Cauchy": m.Cauchy.Create(1.0)}
    kernels |= {"DCS": m.DCS.Create(1.0), "GNC": None}
    false_rows = [pair in false for pair in zip(graph.from_ids.tolist(), graph.to_ids.tolist(), strict=True)]
    for name, kernel in kernels.items():
        factors, values, loops = peer_graph(graph, kernel)
        row = {"true": "", "false": "", "standing": ""}
        started = time.process_time()
        try:
            if name == "iSAM2":
                estimate = isam2(factors, values)
            elif name == "GNC":
                parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
                parameters.setLossType(gtsam.GncLossType.TLS)
                parameters.setKnownInliers([k for k in range(factors.size()) if k not in set(loops)])
                optimizer = gtsam.GncLMOptimizer(factors, values, parameters)
                optimizer.setInlierCostThresholdsAtProbability(0.99)
                estimate = optimizer.optimize()
                kept = np.asarray(optimizer.getWeights())[loops] > 0.5
                wrong = np.array(false_rows)[np.array(loops) - 1]
                row |= {"true": int((kept & ~wrong).sum()), "false": int((kept & wrong).sum())}
            else:
                estimate = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
            poses = gtsam.utilities.extractPose2(estimate)
            T = np.tile(np.eye(4), (len(poses), 1, 1))
            T[:, :2, 3] = poses[:, :2]
            yield name, row | {"ate": files.ate(T, truth), "cpu_s": time.process_time() - started}
        except RuntimeError as error:
            yield name, row | {"ate": float("nan"), "cpu_s": time.process_time() - started, "standing": str(error)[:40]}


def show(name, row):
    kept = f"{row['true']} + {row['false']}"
    print(f"    {name:12} kept {kept:9} ATE {row['ate']:7.2f} m  {row['cpu_s']:6.2f} s  {row['standing']}", flush=True)


def cases(root, arguments):
    """Yield name, graph, pairs of false loops and true poses."""
    for sequence in arguments.sequences or ["06", "00"]:
        if arguments.seeds == 0:
            for name in ("alpha_0.30", "false_random", "false_consistent"):
                graph, truth = files.kitti(root / sequence, name)
                sound = files.true_edges(graph, truth) | (graph.to_ids == graph.from_ids + 1)
                pairs = zip(graph.from_ids[~sound].tolist(), graph.to_ids[~sound].tolist(), strict=True)
                yield f"{sequence} {name}", graph, set(pairs), truth
            continue
        plane, flat_truth = files.kitti(root / sequence, "alpha_0.30")
        for kind in arguments.kinds or files.KINDS:
            for seed in range(arguments.seeds):
                graph, truth = plane, flat_truth
                if arguments.spatial:
                    graph, truth = files.lifted(plane, flat_truth, np.random.default_rng(seed))
                graph, false = files.with_false_loops(graph, truth, kind, seed)
                yield f"{sequence} {kind} {seed}", graph, false, truth


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--kinds", nargs="*")
    parser.add_argument("--spatial", action="store_true")
    parser.add_argument("--no-live", action="store_true")
    arguments = parser.parse_args()
    for name, graph, false, truth in cases(arguments.folder, arguments):
        alone = ours(without(graph, false), set(), truth, live=False)
        print(
            f"{name}: true loops alone {alone['true']}, ATE {alone['ate']:.2f} m; false loops {len(false)}", flush=True
        )
        show("batch", ours(graph, false, truth, live=False))
        if not arguments.no_live:
            show("live", ours(graph, false, truth, live=True))
        if arguments.peers:
            for peer, row in peers(graph, false, truth):
                show(peer, row)


if __name__ == "__main__":
    main()
