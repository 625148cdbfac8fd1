"""What verification costs, and whether places are answered while the back end maps and solves.

    .venv/bin/python benchmarks/backend_latency.py [--course office] [--keyframes 10000]

CPU of ``verify`` by outcome; then wall time of ``Slam.locate`` (five candidates verified against the map) while nothing
else happens, while keyframes are mapped without a pause, and while the solver process solves a graph of many keyframes
from scratch again and again. Features and words of the query are not in it.
"""

import argparse
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from loop_courses import COURSES, Replay, replay

from seamark.backend.config import BackendConfig
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.slam import Slam
from seamark.backend.solver import SolverProcess
from seamark.backend.verify import Rejected, verify
from seamark.frontend import se3

ROUNDS = 150


def costs(made: Replay) -> None:
    known = {keyframe.id: keyframe for keyframe in made.keyframes}
    spent: dict[str, list[float]] = defaultdict(list)
    for candidates in made.candidates:
        for candidate in candidates.ranked[:2]:
            pair = known[candidates.query_id], known[candidate.id]
            took = []
            for _ in range(3):
                begun = time.thread_time()
                result = verify(*pair, BackendConfig().verification, 1)
                took.append(1e3 * (time.thread_time() - begun))
            spent[str(result.reason) if isinstance(result, Rejected) else "verified"].append(min(took))
    print("| verify | pairs | CPU ms p50 | p95 |\n|---|---|---|---|")
    for name, times in sorted(spent.items()):
        print(f"| {name} | {len(times)} | {np.median(times):.1f} | {np.percentile(times, 95):.1f} |", flush=True)


def ask(slam: Slam, made: Replay, rounds: int = ROUNDS) -> str:
    """Return p50, p95 and p99 of the wall time of a query, in ms."""
    times = []
    for number in range(rounds):
        which = (37 * number) % len(made.keyframes)
        query, candidates = replace(made.keyframes[which], id=-1, session=-1), made.candidates[which]
        begun = time.perf_counter()
        slam.locate(query, replace(candidates, query_id=-1))
        times.append(1e3 * (time.perf_counter() - begun))
        time.sleep(0.005)
    return " | ".join(f"{value:.1f}" for value in np.percentile(times, (50, 95, 99)))


def busy(work: Callable[[threading.Event], int], slam: Slam, made: Replay) -> tuple[str, int]:
    """Return what :func:`ask` says while ``work`` runs in a thread, and how much that has done."""
    stop, done = threading.Event(), [0]
    thread = threading.Thread(target=lambda: done.__setitem__(0, work(stop)))
    thread.start()
    answer = ask(slam, made)
    stop.set()
    thread.join()
    return answer, done[0]


def solving(keyframes: int) -> Callable[[threading.Event], int]:
    def work(stop: threading.Event) -> int:
        solver, rounds = SolverProcess(BackendConfig()), 0
        step = se3.make(se3.exp_rotation(np.array([0, 0.01, 0])), np.array([0.3, 0, 0]))
        T = np.eye(4)
        for number in range(keyframes):
            solver.add_keyframe(Node(number, 0, number - 1 if number else None, T, 1e-6 * np.eye(6)))
            T = T @ step
            if number % 50 == 49 and number > 700:
                solver.add_loop(Constraint(number, number - 628, np.eye(4), 1e-4 * np.eye(6)))
        while not stop.is_set():
            solver.optimise(thorough=True)
            rounds += 1
        solver.close()
        return rounds

    return work


def mapping(made: Replay) -> Callable[[threading.Event], int]:
    def work(stop: threading.Event) -> int:
        count = 0
        while not stop.is_set():
            solver = SolverProcess(BackendConfig())
            again = Slam(BackendConfig(), made.mode, solver, 1)
            for keyframe, candidates in zip(made.keyframes, made.candidates, strict=True):
                if stop.is_set():
                    break
                again.step(keyframe, candidates)
                count += 1
            solver.close()
        return count

    return work


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--course", choices=COURSES, default="office")
    parser.add_argument("--keyframes", type=int, default=10000)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    made = replay(options.course, 0)
    costs(made)
    solver = SolverProcess(BackendConfig())
    slam = Slam(BackendConfig(), made.mode, solver, 1)
    for keyframe, candidates in zip(made.keyframes, made.candidates, strict=True):
        slam.step(keyframe, candidates)
    print("\n| while | locate ms p50 | p95 | p99 | done meanwhile |\n|---|---|---|---|---|")
    print(f"| idle | {ask(slam, made)} | |", flush=True)
    answer, count = busy(mapping(made), slam, made)
    print(f"| mapping | {answer} | {count} keyframes |", flush=True)
    answer, count = busy(solving(options.keyframes), slam, made)
    print(f"| solving {options.keyframes} keyframes | {answer} | {count} times |", flush=True)
    solver.close()


if __name__ == "__main__":
    main()
