"""All the runs that docs/benchmarks.md reports, by hand:  .venv/bin/python benchmarks/end_to_end.py DATA [NAME...]

DATA is the folder with the real sequences. Prints a Markdown table and leaves the results in build/benchmarks.
"""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from seamark.frontend import se3
from seamark.service.sources.open import open_sources
from seamark.service.stamps import parse_stamp

OUT = Path("build/benchmarks")
COMMAND = [sys.executable, "-c", "from seamark.service.cli import main; main()"]
WEAK = ["-o", "frontend.max_corners=60", "-o", "frontend.window_keyframes=3", "-o", "frontend.window_iterations=1"]
RUNS: dict[str, list[str]] = {
    "tum_fr1_rpy rgbd": ["{data}/tum_fr1_rpy"],
    "rgbd_hololens rgbd": ["{data}/rgbd_hololens"],
    "kitti06 stereo": ["{data}/kitti06_stereo_000-050"],
    "kitti06 mono": ["{data}/kitti06_stereo_000-050", "--mode", "mono"],
    "rgbd_hololens mono": ["{data}/rgbd_hololens", "--mode", "mono"],
    "euroc_v101 stereo keyframes": ["{data}/euroc_v101_stereo_keyframes"],
    "gardens_point places": ["{data}/gardens_point/day_left", "{data}/gardens_point/day_right", "--mode", "places"],
    "synth:loop rgbd": ["synth:loop"],
    "synth:loop rgbd, weak odometry": ["synth:loop", *WEAK],
    "synth:loop rgbd, cheap camera": ["synth:loop,sensor=cheap"],
    "synth:loop stereo": ["synth:loop,sensors=stereo"],
    "synth:loop mono": ["synth:loop", "--mode", "mono"],
}


COLUMNS = (
    *("run", "tracked", "sessions", "m", "ATE odometry m", "ATE corrected m", "loops +/-"),
    *("accepted loops against the truth", "frame ms p50/p95/p99", "frames/s", "CPU ms/frame", "peak MiB f v b r"),
)


def run(name: str, words: list[str]) -> dict[str, Any]:
    folder = OUT / re.sub(r"[^a-z0-9]+", "_", name)
    done = subprocess.run([*COMMAND, "run", *words, "--out", str(folder), "--json"], capture_output=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{name}: {done.stderr.decode()}")
    report: dict[str, Any] = json.loads(done.stdout)
    report["folder"] = str(folder)
    return report


def loop_errors(report: dict[str, Any], words: list[str]) -> str:
    """Compare accepted loops with the truth: relative pose errors, or distances in place index."""
    with (Path(report["folder"]) / "loops.csv").open() as file:
        loops = [row for row in csv.DictReader(file) if row["accepted"] == "1"]
    if report["mode"] == "places":
        return place_errors(loops)
    mode = words[words.index("--mode") + 1] if "--mode" in words else None
    sources = words[: next((i for i, word in enumerate(words) if word.startswith("-")), len(words))]
    truth = open_sources(sources, mode=mode).ground_truth
    if truth is None or not loops or mode == "mono":
        return "-"
    metres, degrees = [], []
    for loop in loops:
        query, match = (
            truth.T_world_cam[nearest(truth.stamps_ns, loop[key])] for key in ("query_stamp", "match_stamp")
        )
        T_match_query = np.eye(4)
        T_match_query[:3, :3] = se3.from_quaternion(np.array([float(loop[key]) for key in ("qx", "qy", "qz", "qw")]))
        T_match_query[:3, 3] = [float(loop[key]) for key in ("tx", "ty", "tz")]
        error = se3.inverse(T_match_query) @ se3.inverse(match) @ query
        metres.append(float(np.linalg.norm(error[:3, 3])))
        degrees.append(float(np.rad2deg(se3.rotation_angle(error[:3, :3]))))
    return (
        f"{np.median(metres) * 100:.1f} cm {np.median(degrees):.2f} deg median,"
        f" {max(metres) * 100:.1f} cm {max(degrees):.2f} deg worst"
    )


def place_errors(loops: list[dict[str, str]]) -> str:
    right, wrong = set(), 0
    for loop in loops:
        query, match = (re.match(r"(.*)/Image(\d+)", loop[key]) for key in ("query_file", "match_file"))
        assert query and match
        if query[1] != match[1] and abs(int(query[2]) - int(match[2])) <= 3:
            right.add(query[2])
        else:
            wrong += 1
    return f"{len(right)} of 200 places found (+-3), {wrong} accepted elsewhere"


def nearest(stamps_ns: np.ndarray, stamp: str) -> int:
    return int(np.abs(stamps_ns - parse_stamp(stamp)).argmin())


def row(name: str, words: list[str]) -> str:
    report = run(name, words)
    accuracy = report["accuracy"]
    before, after, length = "-", "-", "-"
    if accuracy:
        before = f"{accuracy['odometry']['ate']['translation_m']['rmse']:.4f}"
        after = f"{accuracy['corrected']['ate']['translation_m']['rmse']:.4f}"
        length = f"{accuracy['corrected']['ate']['length_m']:.1f}"
    loops, frames, latency = report["loops"], report["frames"], report["latency_ms"]["frame"]
    memory = " ".join(f"{p['name'][0]}{p['peak_rss_bytes'] // 2**20}" for p in report["processes"])
    cpu = 1e3 * sum(p["cpu_s"] for p in report["processes"]) / frames["total"]
    cells = (
        name,
        f"{frames['tracked']}/{frames['total']}",
        len(report["sessions"]),
        length,
        before,
        after,
        f"{loops['accepted']}/{loops['rejected']}",
        loop_errors(report, words),
        f"{latency['p50']:.0f}/{latency['p95']:.0f}/{latency['p99']:.0f}",
        f"{report['frames_per_second']:.1f}",
        f"{cpu:.0f}",
        memory,
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    data, names = sys.argv[1], sys.argv[2:] or list(RUNS)
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for name in names:
        words = [word.format(data=data) for word in RUNS[name]]
        print(row(name, words), flush=True)


if __name__ == "__main__":
    main()
