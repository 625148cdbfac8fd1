"""What a step of the front end costs, by stage:  .venv/bin/python benchmarks/frontend_speed.py DATA [NAME...]

DATA is the folder with the real sequences. Stages and steps are in milliseconds of CPU of the tracking thread, median /
95th percentile, which other programs do not disturb, and steps in wall time as well. CPU per frame includes the
keyframe thread; reading files is left out. Each run has a process of its own, whose peak RSS is that of all it did
(the interpreter, decoding images and the sequence's own buffers included). Without a pause between frames keyframes
wait for their SIFT; with ``--rate`` frames come as from a camera.
"""

import argparse
import multiprocessing
import resource
import sys
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
from real_sequences import REAL

from seamark.frontend.config import FrontendConfig
from seamark.frontend.odometry import Frontend
from seamark.service.evaluation import Alignment, ate
from seamark.service.sources.open import open_sources
from seamark.service.types import Trajectory

STAGES = ("track", "pose", "settle", "keyframe")
COLUMNS = (
    *("run", *STAGES, "step CPU", "step CPU at keyframes", "step wall", "frames/s", "keyframes"),
    *("CPU ms/frame", "peak MiB", "ATE m"),
)


def measure(spec: str, mode: str, rate: float | None) -> list[str]:
    """Run one sequence, a frame every 1 / rate seconds or without a pause, and return the cells of its row."""
    cv2.setNumThreads(1)
    source = open_sources([spec], mode=mode)
    assert source.ground_truth is not None
    frontend = Frontend(source.rig, source.mode, FrontendConfig(), clock=time.thread_time)
    said, stages = [], defaultdict[str, list[float]](list)
    wall_ms, own_ms, cpu_s = [], [], 0.0
    begin = time.perf_counter()
    for frame in source.frames():
        if rate is not None:
            time.sleep(max(0.0, begin + frame.index / rate - time.perf_counter()))
        wall, own, cpu = time.perf_counter(), time.thread_time(), time.process_time()
        said.append(frontend.step(frame).odometry)
        wall_ms.append(1e3 * (time.perf_counter() - wall))
        own_ms.append(1e3 * (time.thread_time() - own))
        cpu_s += time.process_time() - cpu
        for stage, ms in said[-1].stages_ms.items():
            stages[stage].append(ms)
    cpu = time.process_time()
    frontend.finish()
    cpu_s += time.process_time() - cpu
    frontend.close()
    posed = [o for o in said if o.T_odom_cam is not None]
    estimate = Trajectory(
        np.array([o.stamp_ns for o in posed]), np.stack([o.T_odom_cam for o in posed if o.T_odom_cam is not None])
    )
    alignment = Alignment.SIM3 if mode == "mono" else Alignment.SE3
    error_m = ate(estimate, source.ground_truth, alignment).translation_m.rmse
    at_keyframe = np.array([o.keyframe_id is not None for o in said])
    return [
        *(pair(stages[stage]) for stage in STAGES),
        pair(own_ms),
        pair(np.array(own_ms)[at_keyframe]),
        pair(wall_ms),
        "-" if rate else f"{1e3 * len(said) / sum(wall_ms):.0f}",
        f"{at_keyframe.sum()} of {len(said)}",
        "-" if rate else f"{1e3 * cpu_s / len(said):.1f}",
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
        f"{error_m:.4f}",
    ]


def pair(ms: list[float] | np.ndarray) -> str:
    return "{:.1f} / {:.1f}".format(*np.percentile(ms, [50, 95])) if len(ms) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with the real sequences")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(REAL)}")
    parser.add_argument("--rate", type=float, help="frames per second that arrive; without it one follows the other")
    given = parser.parse_intermixed_args()
    unknown = set(given.names) - set(REAL)
    if unknown:
        sys.exit(f"unknown: {', '.join(sorted(unknown))}")
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for name in given.names or REAL:
        folder, mode = REAL[name]
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            cells = pool.apply(measure, (str(given.data / folder), mode, given.rate))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
