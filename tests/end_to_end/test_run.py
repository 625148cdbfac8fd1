"""`seamark run` end to end: one run per mode, over processes and in one, on toy and on real data."""

import csv
import json
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from seamark.service.config import load_config
from seamark.service.run import RunOptions, run
from seamark.service.sources.open import open_sources

REAL_DATA = Path(__file__).parents[2].parent / "shared" / "data"
QUICK = ["-o", "frontend.max_corners=250", "-o", "frontend.sift_features=400"]
COMMAND = [sys.executable, "-c", "from seamark.service.cli import main; main()"]
FILES = {
    "trajectory.tum",
    "odometry.tum",
    "keyframes.tum",
    "frames.csv",
    "loops.csv",
    "map.seamark",
    "run.rrd",
    "trajectory.png",
    "config.yaml",
    "report.json",
}


def seamark(*words: object, ok: bool = True) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=280, check=False)
    if ok:
        assert done.returncode == 0, done.stderr[-3000:]
    return done


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def with_other_focal_length(source: Path, folder: Path, factor: float) -> Path:
    folder.mkdir()
    for name in ("rgb", "depth", "associations.txt", "groundtruth.txt"):
        (folder / name).symlink_to(source / name)
    lines = (source / "calib.yaml").read_text().splitlines()
    settings = dict(line.split(": ") for line in lines)
    for key in ("fx", "fy"):
        settings[key] = str(factor * float(settings[key]))
    (folder / "calib.yaml").write_text("".join(f"{key}: {value}\n" for key, value in settings.items()))
    return folder


@pytest.mark.zenoh
def test_rgbd_over_processes_closes_its_loop(toy_tum: Path, n_frames: int, tmp_path: Path) -> None:
    """Test: one lap and a bit, with a focal length that is 1 % wrong. Expected: the loop corrects what that bends."""
    out = tmp_path / "out"
    bent = with_other_focal_length(toy_tum, tmp_path / "bent", 1.01)
    report = json.loads(seamark("run", bent, "--out", out, "--json", *QUICK).stdout)
    assert {path.name for path in out.iterdir()} == FILES
    assert report == json.loads((out / "report.json").read_text())
    assert report["mode"] == "rgbd"
    assert report["frames"]["total"] == n_frames
    assert report["frames"]["tracked"] == n_frames
    assert report["loops"]["accepted"] >= 1
    odometry, corrected = (report["accuracy"][key]["ate"] for key in ("odometry", "corrected"))
    assert corrected["alignment"] == "se3"
    assert 15 < corrected["length_m"] < 18
    assert 0.001 < corrected["translation_m"]["rmse"] < 0.03
    assert corrected["translation_m"]["rmse"] < 0.9 * odometry["translation_m"]["rmse"]
    assert {process["name"] for process in report["processes"]} == {"frontend", "vocab", "backend", "runner"}

    frames = rows(out / "frames.csv")
    assert len(frames) == n_frames
    assert all(1 < float(frame["latency_ms"]) < 10_000 for frame in frames)
    accepted = [loop for loop in rows(out / "loops.csv") if loop["accepted"] == "1"]
    assert accepted
    for loop in accepted:  # one lap is 16.3 m in n_frames / 1.08 frames at 15 Hz
        apart = float(loop["query_stamp"]) - float(loop["match_stamp"])
        assert 0.55 * n_frames / 15 < apart < 1.05 * n_frames / 15
    with sqlite3.connect(out / "map.seamark") as database:
        (stored,) = database.execute("select count(*) from keyframes").fetchone()
    assert stored == report["keyframes"] == len((out / "keyframes.tum").read_text().splitlines()) - 1


def test_two_runs_in_process_are_identical(toy_tum: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        seamark("run", toy_tum, "--out", tmp_path / name, "--in-process", *QUICK)
    for file in sorted(FILES):
        if file.endswith((".tum", ".csv")):
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    assert len(rows(tmp_path / "a" / "loops.csv")) > 0


@pytest.mark.parametrize(("mode", "alignment"), [("stereo", "se3"), ("mono", "sim3")])
def test_kitti_layout(toy_kitti: Path, tmp_path: Path, mode: str, alignment: str) -> None:
    out = tmp_path / "out"
    words = ("run", toy_kitti, "--out", out, "--mode", mode, "--in-process", "--no-loops", "--json", *QUICK)
    report = json.loads(seamark(*words).stdout)
    figures = report["accuracy"]["odometry"]["ate"]
    assert figures["alignment"] == alignment
    assert 0 < figures["translation_m"]["rmse"] < 0.05
    assert report["loops"]["accepted"] == 0
    corrected = np.loadtxt(out / "trajectory.tum")
    assert len(corrected) == 40  # mono: the frames before initialisation are filled in
    assert np.all(np.diff(corrected[:, 0]) > 0)


@pytest.mark.zenoh
def test_places_without_calibration(toy_tum: Path, n_frames: int, tmp_path: Path) -> None:
    out = tmp_path / "out"
    folder = toy_tum / "rgb"
    report = json.loads(seamark("run", folder, "--out", out, "--json", *QUICK).stdout)
    assert report["mode"] == "places"
    assert report["keyframes"] == n_frames
    assert (out / "trajectory.tum").read_text() == "# stamp tx ty tz qx qy qz qw\n"
    accepted = [loop for loop in rows(out / "loops.csv") if loop["accepted"] == "1"]
    lap = n_frames / 1.08  # one image per second
    assert len(accepted) >= 3
    off = [abs(float(loop["query_stamp"]) - float(loop["match_stamp"]) - lap) for loop in accepted]
    assert max(off) <= 20  # 60 degrees of the circle at most: the same wall is in view
    assert np.median(off) <= 6
    assert all(loop["tx"] == loop["qw"] == "" for loop in accepted)


@pytest.mark.real_data
def test_real_rgbd_sequence(tmp_path: Path) -> None:
    """Test: the first 120 pairs of a hand-held sequence. Expected: all tracked, 1 to 8 cm from motion capture."""
    source = REAL_DATA / "tum_fr1_rpy"
    if not source.is_dir():
        pytest.skip(f"REAL DATA MISSING: {source} is not there, so nothing real was tested")
    short = tmp_path / "fr1_rpy"
    short.mkdir()
    for name in ("rgb", "depth", "groundtruth.txt", "calib.yaml"):
        (short / name).symlink_to(source / name)
    lines = [line for line in (source / "associations.txt").read_text().splitlines() if not line.startswith("#")]
    (short / "associations.txt").write_text("\n".join(lines[:120]) + "\n")
    out = tmp_path / "out"
    report = json.loads(seamark("run", short, "--out", out, "--json").stdout)
    assert report["frames"]["tracked"] == 120
    assert 0.005 < report["accuracy"]["corrected"]["ate"]["translation_m"]["rmse"] < 0.08


def test_a_record_does_not_hold_what_was_for_the_recording_only(toy_kitti: Path, tmp_path: Path) -> None:
    """Expected: tracks pass by with every frame, and none are left at the end, however long the run."""
    seen = []
    record = run(
        open_sources([str(toy_kitti)], mode="mono"),
        RunOptions(tmp_path / "out", (str(toy_kitti),), in_process=True),
        load_config(overrides=["service.record=false", "frontend.sift_features=200"]),
        lambda done, total, odometry: seen.append(len(odometry.tracks)),
    )
    assert len(record.odometry) == len(seen) == 40
    assert max(seen) > 50
    assert sum(len(odometry.tracks) for odometry in record.odometry) == 0
