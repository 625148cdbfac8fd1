"""Robustness of the back end on the KITTI pose graphs with about 70 % false loops (SE2 lifted to SE3).

    .venv/bin/python benchmarks/backend_posegraph.py ../shared/data/posegraph_kitti [00 06]

Prints per graph: loops, true ones among those accepted, false ones accepted, ATE in m after SE(3) alignment and CPU
seconds. ``batch`` finds the largest consistent set of all loops at once; ``online`` meets the loops one by one as
``Slam.step`` does (odometry gate, mutual consistency with the nearest loops, withdrawal), without geometry's help:
every loop counts as weak. ``true only`` is what the same graph makes of the true loops alone.
"""

import sys
import time
from pathlib import Path

import numpy as np

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import consistent_matrix, gate_chi2, greedy_clique
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.ledger import Finding, LoopLedger, PoseRelation
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.types import Reason
from seamark.frontend import se3

# The files' own noise is far too confident. Chosen before the runs: odometry 0.05 m, 0.005 rad; loops 0.3 m, 0.03 rad.
# The back end doubles odometry's sigmas itself, so it is given half.
ODOMETRY = np.diag([0.0025**2] * 3 + [0.025**2] * 3)
LOOP = np.diag([0.03**2] * 3 + [0.3**2] * 3)
TRUE_WITHIN_M = 5.0


def lift(x, y, theta):
    return se3.make(se3.exp_rotation(np.array([0, 0, theta])), np.array([x, y, 0]))


def read(path):
    """Return the chain of odometry poses and the loops (query, match, T_match_query) of a file."""
    poses, loops = [np.eye(4)], []
    for line in path.read_text().splitlines():
        words = line.split()
        if not words or words[0] != "EDGE_SE2":
            continue
        i, j, T = int(words[1]), int(words[2]), lift(*map(float, words[3:6]))
        if j == i + 1:
            poses.append(poses[-1] @ T)
        elif i > j:
            loops.append((i, j, se3.inverse(T)))
        else:
            loops.append((j, i, T))
    return np.array(poses), loops


def ate(T, truth):
    a, b = T[:, :3, 3], truth[: len(T), :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, _, Vt = np.linalg.svd(b0.T @ a0)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(((b0 - a0 @ R.T) ** 2).sum(1).mean()))


def load(folder, name):
    """Return nodes, constraints, which of them are true, and the true poses of one graph."""
    truth, _ = read(folder / f"kitti_{folder.name}_GT.g2o")
    odometry, loops = read(folder / f"kitti_{folder.name}_{name}.g2o")
    nodes = [Node(k, 0, k - 1 if k else None, T, ODOMETRY) for k, T in enumerate(odometry)]
    constraints = [Constraint(*loop, LOOP) for loop in sorted(loops, key=lambda x: x[:2])]
    gaps = [np.linalg.norm(truth[x.query_id][:3, 3] - truth[x.match_id][:3, 3]) for x in constraints]
    return nodes, constraints, np.array(gaps) < TRUE_WITHIN_M, truth


def solve(nodes, loops, config):
    graph = PoseGraph(config)
    for node in nodes:
        graph.add_keyframe(node)
    for loop in loops:
        graph.add_loop(loop)
    return graph.optimise(thorough=True).T_map_cam


def batch(nodes, constraints, config):
    """Return which loops the largest consistent set of all holds, and the poses."""
    chains = OdometryChains(config.drift)
    for node in nodes:
        chains.add(node)
    agree = consistent_matrix(constraints, chains, config.consistency.pair_chi2)
    kept = greedy_clique(agree, np.ones(len(constraints)), config.consistency.clique_starts)
    return kept, solve(nodes, [c for c, keep in zip(constraints, kept, strict=True) if keep], config)


def online(nodes, constraints, config):
    """Return which loops are accepted in the end when they come one by one, and the poses."""
    chains, graph = OdometryChains(config.drift), PoseGraph(config)
    ledger = LoopLedger(
        PoseRelation(chains, config.consistency), config.consistency.compared_loops, config.consistency.clique_starts
    )
    coming = {}
    for constraint in constraints:
        coming.setdefault(constraint.query_id, []).append(constraint)
    committed = set()
    for node in nodes:
        chains.add(node)
        graph.add_keyframe(node)
        changed = False
        for constraint in coming.get(node.id, []):
            if not gate_chi2(constraint, chains) <= config.consistency.gate_chi2:
                continue
            finding = Finding(constraint.query_id, constraint.match_id, 0, 0, 20, constraint)
            for key, reason in ledger.add(finding).items():
                if (reason == Reason.ACCEPTED) == (key in committed):
                    continue
                changed = True
                if reason == Reason.ACCEPTED:
                    graph.add_loop(ledger.finding(key).constraint)
                    committed.add(key)
                else:
                    graph.remove_loop(*key)
                    committed.discard(key)
        if changed:
            graph.optimise()
    kept = np.array([(c.query_id, c.match_id) in committed for c in constraints])
    return kept, graph.optimise(thorough=True).T_map_cam


def main():
    root = Path(sys.argv[1])
    config = BackendConfig()
    for sequence in sys.argv[2:] or ["06", "00"]:
        for name in ("alpha_0.30", "false_random", "false_consistent"):
            nodes, constraints, true, truth = load(root / sequence, name)
            alone = ate(solve(nodes, [c for c, t in zip(constraints, true, strict=True) if t], config), truth)
            odometry = ate(np.array([node.T_odom_cam for node in nodes]), truth)
            print(
                f"{sequence} {name}: {len(constraints)} loops, {true.sum()} true; odometry {odometry:.2f} m, ", end=""
            )
            print(f"true only {alone:.2f} m", flush=True)
            for method in (batch, online):
                started = time.process_time()
                kept, poses = method(nodes, constraints, config)
                seconds = time.process_time() - started
                print(
                    f"    {method.__name__:7} kept {(kept & true).sum()} true {(kept & ~true).sum()} false, "
                    f"ATE {ate(poses, truth):.2f} m, {seconds:.1f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
