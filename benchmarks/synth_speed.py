"""How fast and how steadily worlds are rendered: frames per second, CPU time by stage, start-up, memory.

    .venv/bin/python benchmarks/synth_speed.py [SPECIFICATION] [--stages 60]

Renders SPECIFICATION (loop,frames=400) as ``seamark synth render`` does, into a folder that is deleted afterwards:
wall seconds from before the workers are started until the last file is written, CPU seconds (user and system) of
workers and parent, and their resident memory along the way. Then, in a process of its own, ``--stages`` frames from the
middle of it, every other one as one of two workers makes them, with the CPU time of each stage. Where others use the
machine, trust CPU seconds and the fastest of several runs.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from seamark.datasets_synth import folder, optics, sensor, specification, studio
from seamark.datasets_synth.renderer import Renderer
from seamark.datasets_synth.rendering import FRAMES_AHEAD, RenderPool
from seamark.datasets_synth.specification import Specification

SAMPLES = 9
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def cpu_s(process: int) -> float:
    """Return CPU seconds, user and system, that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def resident_mb(process: int) -> float:
    """Return the resident memory of a process."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def render(wanted: Specification) -> dict[str, Any]:
    """Render everything and return what it cost."""
    memory: dict[int, list[int]] = {}
    before_the_end = max(0, wanted.frames - 5 * FRAMES_AHEAD)  # while the workers are still there
    sample_at = set(np.linspace(min(20, before_the_end), before_the_end, SAMPLES).astype(int).tolist())
    begin, begin_cpu = time.perf_counter(), cpu_s(os.getpid())
    with tempfile.TemporaryDirectory() as name, RenderPool(wanted) as pool:
        folder.start(Path(name), wanted.mode, labels=wanted.labels > 0)
        for coded in pool.frames():
            if coded.index == 0:
                first, first_cpu = time.perf_counter() - begin, [cpu_s(process) for process in pool.pids]
            folder.store(Path(name), coded)
            if coded.index in sample_at:
                memory[coded.index + 1] = [round(resident_mb(process)) for process in (*pool.pids, os.getpid())]
            if coded.index == wanted.frames - 1:
                wall, workers = time.perf_counter() - begin, [cpu_s(process) for process in pool.pids]
    used = cpu_s(os.getpid()) - begin_cpu
    return {
        "frames_per_s": wanted.frames / wall,
        "wall_s": wall,
        "first_frame_s": first,
        "worker_cpu_s": workers,
        "worker_cpu_s_at_first_frame": first_cpu,
        "parent_cpu_s": used,
        "cpu_ms_per_frame": 1000 * (sum(workers) + used) / wanted.frames,
        "resident_mb": memory,
    }


def measure_stages(wanted: Specification, count: int) -> None:
    """Print as JSON the CPU ms of each stage of making frames; in the process of a worker, because it renders."""
    spent: dict[str, list[float]] = defaultdict(list)

    def timed(stage: str, call: Callable[..., Any], *values: Any, **named: Any) -> Any:
        begin = time.process_time()
        result = call(*values, **named)
        spent[stage].append(1000 * (time.process_time() - begin))
        return result

    begin = time.process_time()
    made = studio.Studio(wanted)
    made.frame(0)
    start_up = time.process_time()
    stages: dict[str, list[tuple[Any, str]]] = {
        "drawing": [(Renderer, "render")],
        "metering": [(Renderer, "meter")],
        "motion and blur": [(studio.Studio, "_blurred")],
        "lens": [(optics.Lens, name) for name in ("colour", "depth", "labels")],
        "noise": [(sensor, "expose")],
        "depth model": [(sensor, "measure_depth")],
        "JPEG": [(sensor, "code_picture")],
        "depth coding": [(sensor, "code_depth")],
        "labels coding": [(sensor, "code_labels")],
        "all": [(studio.Studio, "frame")],
    }
    middle = max(0, wanted.frames // 2 - count)
    made.frame(middle)
    indices = range(middle + 2, min(wanted.frames, middle + 2 + 2 * count), 2)  # as one of two workers
    with ExitStack() as stack:
        for stage, places in stages.items():
            for owner, name in places:
                call = getattr(owner, name)
                wrapped = partial(timed, stage, call)
                replacement = wrapped if owner is sensor else _method(wrapped)
                stack.enter_context(mock.patch.object(owner, name, replacement))
        for index in indices:
            made.frame(index)
    per_frame = {stage: sum(values) / len(indices) for stage, values in spent.items()}
    sys.stdout.write(json.dumps({"process_cpu_s": start_up, "studio_cpu_s": start_up - begin, "ms": per_frame}))
    sys.stdout.flush()
    os._exit(0)  # as the worker does


def _method(call: Callable[..., Any]) -> Callable[..., Any]:
    return lambda owner, *values, **named: call(owner, *values, **named)


def stages(text: str, count: int) -> dict[str, Any]:
    """Return the start-up and the stages of frames of a worker of its own."""
    environment = {**os.environ, "LP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, text, "--stages", str(count), "--as-worker"]
    answer = subprocess.run(command, capture_output=True, env=environment, check=True)
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("specification", nargs="?", default="loop,frames=400")
    parser.add_argument("--stages", type=int, default=60)
    parser.add_argument("--as-worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    wanted = specification.parse(options.specification)
    if options.as_worker:
        import cv2

        cv2.setNumThreads(1)
        measure_stages(wanted, options.stages)
    cost = render(wanted)
    print(f"{options.specification}: {json.dumps(asdict(wanted))}")
    print(f"{cost['frames_per_s']:.1f} frames/s, {cost['wall_s']:.1f} s, start-up included")
    print(f"first frame after {cost['first_frame_s']:.1f} s")
    for name in ("worker_cpu_s", "worker_cpu_s_at_first_frame"):
        print(f"{name}: {', '.join(f'{value:.1f}' for value in cost[name])}")
    print(f"parent_cpu_s: {cost['parent_cpu_s']:.1f}")
    print(f"{cost['cpu_ms_per_frame']:.1f} ms CPU per frame, all processes and start-up included")
    print("resident MB of workers and parent after so many frames:")
    for frames, values in cost["resident_mb"].items():
        print(f"  {frames:5d}: {', '.join(map(str, values))}")
    found = stages(options.specification, options.stages)
    print(f"a worker until its first frame: {found['process_cpu_s']:.2f} s CPU, of them", end=" ")
    print(f"{found['studio_cpu_s']:.2f} for world and renderer")
    for stage, milliseconds in sorted(found["ms"].items(), key=lambda item: -item[1]):
        print(f"  {stage:16s} {milliseconds:6.2f} ms CPU per frame")


if __name__ == "__main__":
    main()
