"""What a keyframe waits for the pose graph, and how soon the map knows a loop, as the map grows.

    .venv/bin/python benchmarks/backend_solver_latency.py 1000 10000 30000

A drive through a city of so many keyframes is solved first. Then 200 more come, every tenth with a loop, at 20 of them
a second. ``keyframe``: time spent in the solver's calls for one keyframe, as ``Slam.step`` makes them but without
waiting; ``turnaround``: from the request to its solution. Milliseconds of wall time, p50 / p99 / max.
"""

import sys
import time

import numpy as np
import posegraph_files as files

from seamark.backend.config import BackendConfig
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.solver import SolverProcess
from seamark.frontend import se3

EDGE = np.diag([1e-3**2] * 3 + [1e-2**2] * 3)
LOOP = np.diag([3e-3**2] * 3 + [0.05**2] * 3)
EXTRA, EVERY, PERIOD_S = 200, 10, 0.05


def spread(values):
    ms = 1e3 * np.array(values)
    return f"{np.median(ms):.2f} / {np.percentile(ms, 99):.2f} / {ms.max():.2f}"


def main():
    for count in [int(word) for word in sys.argv[1:]] or [1000]:
        rng = np.random.default_rng(1)
        truth, pairs = files.city(count + EXTRA, 50, rng, every=1)
        pose = truth[0]
        nodes = [Node(0, 0, None, pose, EDGE)]
        for k in range(1, len(truth)):
            motion = np.linalg.inv(truth[k - 1]) @ truth[k] @ files.pose(rng, 0.01, 0.001, planar=False)
            pose = pose @ motion
            pose = se3.orthonormalise(pose) if k % 100 == 0 else pose
            nodes.append(Node(k, 0, k - 1, pose, EDGE))
        loops = {}
        for m, q in pairs:
            T = np.linalg.inv(truth[m]) @ truth[q] @ files.pose(rng, 0.05, 0.003, planar=False)
            loops[q] = Constraint(q, m, T, LOOP)
        solver = SolverProcess(BackendConfig())
        try:
            for node in nodes[:count]:
                solver.add_keyframe(node)
            known = [q for q in loops if q < count and q % 20 == 0]
            for q in known:
                solver.add_loop(loops[q])
            started = time.perf_counter()
            solver.optimise(thorough=True)
            first = time.perf_counter() - started
            solver.optimise()  # iSAM2 takes the map in
            keyframe, turnaround, requested = [], [], None
            for k, node in enumerate(nodes[count:]):
                started = time.perf_counter()
                solver.add_keyframe(node)
                estimate = solver.collect(0.0)
                if estimate is not None and requested is not None:
                    turnaround.append(time.perf_counter() - requested)
                    requested = None
                if k % EVERY == 0:
                    target = loops.get(
                        node.id,
                        Constraint(node.id, node.id - 100, se3.inverse(truth[node.id - 100]) @ truth[node.id], LOOP),
                    )
                    solver.add_loop(target)
                    solver.request()
                    requested = requested or time.perf_counter()
                spent = time.perf_counter() - started
                keyframe.append(spent)
                time.sleep(max(0.0, PERIOD_S - spent))
            print(
                f"{count} keyframes, {len(known)} loops: first solution {first:.2f} s with start of the child",
                flush=True,
            )
            print(
                f"    keyframe {spread(keyframe)} ms, turnaround {spread(turnaround)} ms ({len(turnaround)})",
                flush=True,
            )
        finally:
            solver.close()


if __name__ == "__main__":
    main()
