"""Pose graphs of the standard kind, generated: time and final error beside GTSAM's batch LM and GNC.

    .venv/bin/python benchmarks/backend_generated.py [sphere torus grid city10 city30] [--false 0.2] [--gnc]

Noise is as the covariances say. ``--false``: this share of all loops are groups of false ones. LM starts from
odometry, its loops are Gaussian; GNC (truncated least squares) knows that odometry is sound. CPU seconds, one core.
"""

import argparse
import time

import gtsam
import numpy as np
import posegraph_files as files

from seamark.backend.graph_solve import solve_graph

SEED = 1


def make(name):
    """Return true poses, loops, planar, metres, radians."""
    rng = np.random.default_rng(SEED)
    if name == "sphere":
        return *files.sphere(50, 50), False, 0.05, 0.005
    if name == "torus":
        return *files.torus(50, 100), False, 0.05, 0.005
    if name == "grid":
        return *files.city(3500, 4, rng, every=1), True, 0.05, 0.005
    nodes = {"city1": 1000, "city10": 10_000, "city30": 30_000}[name]
    return *files.city(nodes, 50, rng), True, 0.03, 0.001


def gtsam_graph(graph):
    """Return factors, initial values from odometry, and the positions of the odometry factors."""
    factors, values, odometry = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    axes = [3, 4, 2] if graph.planar else [0, 1, 2, 3, 4, 5]
    noise = gtsam.noiseModel.Gaussian.Covariance(graph.covariances[0][np.ix_(axes, axes)])
    factor, prior = gtsam.BetweenFactorPose3, gtsam.PriorFactorPose3
    if graph.planar:
        factor, prior = gtsam.BetweenFactorPose2, gtsam.PriorFactorPose2

    def variable(T):
        if graph.planar:
            return gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))
        return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])

    last = variable(np.eye(4))
    values.insert(0, last)
    factors.add(prior(0, last, gtsam.noiseModel.Isotropic.Sigma(len(axes), 1e-3)))
    for i, j, T in zip(graph.from_ids.tolist(), graph.to_ids.tolist(), graph.T_from_to, strict=True):
        motion = variable(T)
        if j == i + 1:
            odometry.append(factors.size())
            last = last.compose(motion)
            values.insert(j, last)
        factors.add(factor(i, j, motion, noise))
    return factors, values, [0, *odometry]


def positions(values, planar):
    rows = gtsam.utilities.extractPose2(values) if planar else gtsam.utilities.extractPose3(values)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, : 2 if planar else 3, 3] = rows[:, :2] if planar else rows[:, 9:]
    return T


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["city1", "sphere", "grid", "torus", "city10"])
    parser.add_argument("--false", type=float, default=0.0, dest="share")
    parser.add_argument("--gnc", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.names:
        truth, loops, planar, metres, radians = make(name)
        graph, false = files.measured(truth, loops, np.random.default_rng(SEED + 1), planar, metres, radians), set()
        if arguments.share:
            graph, false = files.with_false_loops(graph, truth, "groups", SEED, arguments.share)
        started = time.process_time()
        solution = solve_graph(graph)
        seconds = time.process_time() - started
        kept = sum(loop.kept for loop in solution.loops)
        wrong = sum(loop.kept for loop in solution.loops if (loop.from_id, loop.to_id) in false)
        stages = " ".join(f"{stage} {value:.2f}" for stage, value in solution.seconds.items())
        print(f"{name}: {len(truth)} nodes, {len(loops)} true loops, {len(false)} false", flush=True)
        error = files.ate(solution.estimate.T_map_cam, truth)
        print(f"    seamark kept {kept - wrong} + {wrong}  {error:.3f} m  {seconds:.2f} s ({stages})", flush=True)
        factors, values, odometry = gtsam_graph(graph)
        print(f"    odometry {files.ate(positions(values, planar), truth):.3f} m", flush=True)
        started = time.process_time()
        estimate = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
        seconds = time.process_time() - started
        print(f"    LM {files.ate(positions(estimate, planar), truth):.3f} m  {seconds:.2f} s", flush=True)
        if arguments.gnc:
            parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
            parameters.setLossType(gtsam.GncLossType.TLS)
            parameters.setKnownInliers(odometry)
            started = time.process_time()
            estimate = gtsam.GncLMOptimizer(factors, values, parameters).optimize()
            seconds = time.process_time() - started
            print(f"    GNC {files.ate(positions(estimate, planar), truth):.3f} m  {seconds:.2f} s", flush=True)


if __name__ == "__main__":
    main()
