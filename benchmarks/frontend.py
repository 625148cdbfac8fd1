"""The front end alone, against ground truth: accuracy and honesty of its covariance.

    .venv/bin/python benchmarks/frontend.py DATA [NAME...]              the real sequences
    .venv/bin/python benchmarks/frontend.py DATA --worlds [NAME...]     rendered loops of 60 m and more, 3 seeds

DATA is the folder with the real sequences. ATE and RPE are of the poses as given at the frame, of the longest session,
after SE(3) alignment, Sim(3) for mono. NEES is the squared error of the motion since the reference keyframe, over its
covariance, per degree of freedom: 1 is honest, more is overconfident; beside it is the share of frames within the 95 %
bound. One process, one thread of OpenCV and BLAS besides that of the keyframes.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from real_sequences import REAL

from seamark.frontend import se3
from seamark.frontend.config import FrontendConfig
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Mode, Odometry
from seamark.service.evaluation import Alignment, associate, ate, rpe
from seamark.service.sources.open import open_sources
from seamark.service.types import Trajectory

PLACES = ("loop,trajectory=loop,frames=780", "twins,frames=790", "street,frames=760")
SEEDS = (0, 1, 2)
CHI2_6DOF_95 = 12.59
COLUMNS = (
    "run | tracked | first pose at | sessions | m | ATE m | ATE % | RPE mm / deg per frame | NEES | within 95 %"
    " | p50 / p95 ms | CPU ms/frame"
)


@dataclass(frozen=True)
class Run:
    """What one run of the front end gave."""

    odometry: list[Odometry]
    truth: Trajectory
    mode: Mode
    step_ms: list[float]
    cpu_ms: float


def run(spec: str, mode: str, config: FrontendConfig) -> Run:
    source = open_sources([spec], mode=mode)
    assert source.ground_truth is not None
    frontend = Frontend(source.rig, source.mode, config)
    said, step_ms, cpu_s = [], [], 0.0
    try:
        for frame in source.frames():
            start, cpu = time.perf_counter(), time.process_time()
            said.append(frontend.step(frame).odometry)
            step_ms.append(1e3 * (time.perf_counter() - start))
            cpu_s += time.process_time() - cpu
        cpu = time.process_time()
        frontend.finish()
        cpu_s += time.process_time() - cpu
    finally:
        frontend.close()
    return Run(said, source.ground_truth, source.mode, step_ms, 1e3 * cpu_s / max(1, len(said)))


def row(name: str, done: Run) -> str:
    posed = [o for o in done.odometry if o.T_odom_cam is not None]
    if len(posed) < 3:
        return f"{name} | {len(posed)}/{len(done.odometry)}" + " | -" * 10
    first = posed[0].index
    counts = Counter(o.session for o in posed)
    longest = [o for o in posed if o.session == counts.most_common(1)[0][0]]
    estimate = Trajectory(
        np.array([o.stamp_ns for o in longest], np.int64), np.stack([np.asarray(o.T_odom_cam) for o in longest])
    )
    alignment = Alignment.SIM3 if done.mode is Mode.MONO else Alignment.SE3
    absolute = ate(estimate, done.truth, alignment)
    relative = rpe(estimate, done.truth, alignment)
    nees = honesty(longest, done.truth, absolute.scale)
    p50, p95 = np.percentile(done.step_ms, [50, 95])
    share = 100 * absolute.translation_m.rmse / max(absolute.length_m, 1e-9)
    cells = (
        *(name, f"{len(longest)}/{len(done.odometry) - first}", str(first), str(len(counts))),
        *(f"{absolute.length_m:.1f}", f"{absolute.translation_m.rmse:.4f}", f"{share:.2f}"),
        f"{1e3 * relative.translation_m.rmse:.1f} / {relative.rotation_deg.rmse:.3f}",
        *(f"{np.mean(nees) / 6:.2f}", f"{100 * np.mean(nees < CHI2_6DOF_95):.0f} %"),
        *(f"{p50:.1f} / {p95:.1f}", f"{done.cpu_ms:.0f}"),
    )
    return " | ".join(cells)


def honesty(posed: list[Odometry], truth: Trajectory, scale: float) -> NDArray[np.float64]:
    """Return the squared Mahalanobis errors of the motions since the reference keyframes."""
    stamps = np.array([o.stamp_ns for o in posed], np.int64)
    true = {int(stamps[i]): truth.T_world_cam[j] for i, j in zip(*associate(stamps, truth.stamps_ns), strict=True)}
    keyframes = {o.keyframe_id: o.stamp_ns for o in posed if o.keyframe_id is not None}
    errors = []
    for o in posed:
        origin = keyframes.get(o.reference_id)
        if o.covariance is None or o.keyframe_id is not None or origin not in true or o.stamp_ns not in true:
            continue
        motion = np.array(o.T_reference_cam)
        covariance = np.array(o.covariance)
        motion[:3, 3] *= scale
        covariance[3:] *= scale
        covariance[:, 3:] *= scale
        T = se3.inverse(motion) @ se3.inverse(true[origin]) @ true[o.stamp_ns]
        error = np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])
        errors.append(float(error @ np.linalg.solve(covariance, error)))
    return np.array(errors)


def worlds(names: list[str]) -> Iterator[str]:
    for place in PLACES:
        for mode in ("rgbd", "stereo", "mono"):
            for seed in SEEDS:
                spec = f"synth:{place},seed={seed},sensors={mode}"
                if not names or any(name in spec for name in names):
                    yield row(spec, run(spec, mode, FrontendConfig()))


def real(data: Path, names: list[str]) -> Iterator[str]:
    for name, (folder, mode) in REAL.items():
        if not names or name in names:
            yield row(name, run(str(data / folder), mode, FrontendConfig()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--worlds", action="store_true")
    wish = parser.parse_intermixed_args()
    cv2.setNumThreads(1)
    print(f"| {COLUMNS} |")
    print("|" + "---|" * len(COLUMNS.split("|")))
    rows = worlds(wish.names) if wish.worlds else real(wish.data, wish.names)
    for line in rows:
        print(f"| {line} |", flush=True)


if __name__ == "__main__":
    main()
