"""The map in numbers: commit latency, bytes per keyframe, opening after a kill, and the same loop driven fifty times.

    .venv/bin/python benchmarks/backend_map.py commit --keyframes 300 --before 10000
    .venv/bin/python benchmarks/backend_map.py recover --keyframes 10000
    .venv/bin/python benchmarks/backend_map.py service --keyframes 10000
    .venv/bin/python benchmarks/backend_map.py prune --keyframes 20000
    .venv/bin/python benchmarks/backend_map.py laps --laps 50

Keyframes are synthetic: descriptors of the length and density of RootSIFT, 800 a picture, a JPEG of 60 kB of noise. Of
one place the descriptors are the same up to noise, so that recognition has something to recognise.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

from seamark import SeamarkError
from seamark.backend.config import BackendConfig, MapConfig, VerificationConfig
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.map_open import loader, restore
from seamark.backend.map_prune import choose, views_in
from seamark.backend.map_store import MapStore
from seamark.backend.slam import Slam
from seamark.backend.solver import SolverProcess
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.camera import Camera
from seamark.frontend.types import Features, Frame, Keyframe, Mode
from seamark.service import topics
from seamark.service.config import load_config
from seamark.service.launcher import Launcher
from seamark.service.nodes.map_keeper import MapKeeper
from seamark.service.nodes.map_pruner import AT_ONCE, MapPruner
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceQuery
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

COUNT = 800
LAP_COUNT = 300  # features of a picture where it is driven round and round: what grows does not depend on it
JPEG_BYTES = 60_000
CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
RADIUS_M = 12.0


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    raw = rng.gamma(0.6, 1.0, (count, 128))
    return np.round(255 * np.sqrt(raw / raw.sum(axis=1, keepdims=True)).clip(0, 1)).astype(np.uint8)


def place(number: int, noise_seed: int = 0, count: int = COUNT) -> tuple[Features, np.ndarray, np.ndarray]:
    """Return features, landmarks and thumbnail of a place, seen with the noise of one visit."""
    rng, noise = np.random.default_rng(number), np.random.default_rng((number, noise_seed))
    landmarks = rng.uniform((-3, -2, 3), (3, 2, 9), (count, 3))
    points = landmarks[:, :2] / landmarks[:, 2:] * 500 + (320, 240) + noise.normal(0, 0.4, (count, 2))
    shifted = descriptors(rng, count).astype(np.int16) + noise.integers(-6, 7, (count, 128))
    seen = Features(
        points.astype(np.float32),
        np.full(count, 8, np.float32),
        np.zeros(count, np.float32),
        shifted.clip(0, 255).astype(np.uint8),
    )
    thumbnail = np.random.default_rng(number + 7).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    return seen, landmarks.astype(np.float32), thumbnail


def pose(step: int, per_lap: int) -> np.ndarray:
    angle = 2 * np.pi * step / per_lap
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = (RADIUS_M * np.sin(angle), 0, RADIUS_M * (np.cos(angle) - 1))
    return T


def keyframe(number: int, per_lap: int, seed: int = 0, count: int = COUNT) -> Keyframe:
    seen, landmarks, thumbnail = place(number % per_lap, seed, count)
    return Keyframe(
        id=number,
        session=0,
        index=number,
        stamp_ns=10**9 * number,
        file=str(number),
        features=seen,
        landmarks=landmarks,
        thumbnail=thumbnail,
        jpeg=np.random.default_rng(number).bytes(JPEG_BYTES),
        camera=CAMERA,
        previous_id=number - 1 if number else None,
        T_odom_cam=pose(number, per_lap),
        covariance=np.diag([1e-6] * 3 + [1e-5] * 3),
    )


def percentiles(values: list[float]) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 2) for q in (50, 99)}


def commit(folder: Path, count: int, before: int) -> dict[str, object]:
    """Commit ``count`` keyframes to a map that has ``before`` of them, alone and beside a solver at work."""
    path, per_lap = folder / "map.seamark", 200
    fill(path, before)
    size = path.stat().st_size if before else 0
    out: dict[str, object] = {"before": before, "keyframes": count}
    solver = SolverProcess(BackendConfig())
    with MapStore(path) as store:
        for number in range(before):
            T = pose(number, per_lap)
            solver.add_keyframe(Node(number, 0, number - 1 if number else None, T, np.diag([1e-6] * 3 + [1e-5] * 3)))
        for again in range(per_lap, before, 10):
            solver.add_loop(Constraint(again, again - per_lap, np.eye(4), 1e-4 * np.eye(6)))
        for name, solving in (("commit_ms", False), ("commit_while_solving_ms", True)):
            if solving and not before:
                continue
            taken, solutions = [], 0
            for number in range(before, before + count):
                one = keyframe(number, per_lap)
                if solving:
                    solutions += solver.collect() is not None
                    solver.request()
                started = time.perf_counter()
                store.add_keyframe(one)
                taken.append(1e3 * (time.perf_counter() - started))
            out[name] = percentiles(taken)
            before += count
            if solving:
                out["solutions"] = solutions
    solver.close()
    out["bytes_per_keyframe"] = (path.stat().st_size - size) // (before - int(str(out["before"])))
    return out


def fill(path: Path, count: int) -> None:
    """Make a map of so many keyframes quickly, all with the same features."""
    template = keyframe(0, 200)
    with MapStore(path) as store:
        store.file.database.execute("PRAGMA synchronous = OFF")  # only here: the file is not what is measured
        for number in range(count):
            previous = number - 1 if number else None
            store.add_keyframe(replace(template, id=number, previous_id=previous, T_odom_cam=pose(number, 200)))
    os.sync()


def recover(folder: Path, count: int) -> dict[str, object]:
    """Fill a map, kill its writer in the midst of it, and open it as the back end does."""
    path = folder / "map.seamark"
    template = keyframe(0, 200)
    child = os.fork()
    if child == 0:
        store = MapStore(path)
        store.file.database.execute("PRAGMA synchronous = OFF")  # only here: the file is not what is measured
        for number in range(count):
            previous = number - 1 if number else None
            T = pose(number, 200)
            store.add_keyframe(replace(template, id=number, previous_id=previous, T_odom_cam=T, jpeg=b"x" * JPEG_BYTES))
        ids = np.arange(count)
        T = np.stack([pose(number, 200) for number in range(count)])
        store.record((), MapSnapshot(1, ids, ids * 0, ids * 0, T, np.ones(count), ()), {"mapped": str(count - 1)})
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    os.sync()  # two gigabytes on their way to the disk are not what is measured
    first, again = open_as_the_back_end(path, count), open_as_the_back_end(path, count)
    return {"keyframes": count, "file_mb": round(path.stat().st_size / 1e6), "first": first, "again": again}


def open_as_the_back_end(path: Path, count: int) -> dict[str, float]:
    """Return how long it takes until a place query could be verified."""
    started, cpu = time.perf_counter(), time.process_time()
    store, solver = MapStore(path), SolverProcess(BackendConfig())
    slam = Slam(BackendConfig(), Mode.RGBD, solver, 0, loader(store))
    restore(slam, store)
    wall_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
    assert len(slam.snapshot().keyframe_ids) == count
    solver.close()
    store.close()
    return {"wall_s": round(wall_s, 2), "cpu_s": round(cpu_s, 2)}


def laps(folder: Path, count: int, per_lap: int, keep: int) -> list[dict[str, Any]]:
    """Drive the same loop again and again with room for ``keep`` views; one row per tenth lap."""
    path, rows = folder / "map.seamark", []
    limits = MapConfig(keyframes=keep, memory_mb=4)
    config = BackendConfig(map=limits, verification=VerificationConfig(candidates=1))
    vocabulary = Vocabulary.default()
    index = PlaceIndex(vocabulary, VocabConfig(exclude_recent_s=20.0))
    solver = SolverProcess(config)
    with MapStore(path) as store:
        slam = Slam(config, Mode.RGBD, solver, 0, loader(store))
        meter = Meter("backend")
        pruner = MapPruner(
            MapKeeper(store, meter), slam, limits, meter, lambda gone: [index.remove(number) for number in gone]
        )
        for lap in range(count):
            found, query_ms, step_ms = 0, [], []
            for step in range(per_lap):
                one = keyframe(lap * per_lap + step, per_lap, lap, LAP_COUNT)
                observation = PlaceObservation(
                    one.id, 0, one.stamp_ns, one.features.descriptors, one.features.points, one.thumbnail
                )
                store.add_keyframe(one)
                started = time.perf_counter()
                candidates: Candidates = index.step(observation)
                query_ms.append(1e3 * (time.perf_counter() - started))
                started = time.perf_counter()
                result = slam.step(one, candidates)
                step_ms.append(1e3 * (time.perf_counter() - started))
                snapshot = slam.snapshot() if result.optimised else None
                store.record(result.loops, snapshot, {"mapped": str(one.id)})
                found += any(loop.accepted and loop.match_id % per_lap == step for loop in result.loops)
                pruner.mapped(one.id)
            if lap in (1, 4) or lap % 10 == 9:
                row = {
                    "lap": lap + 1,
                    "keyframes": (lap + 1) * per_lap,
                    "views": len(store.keyframe_ids(recognisable=True)),
                    "nodes": len(slam.snapshot().keyframe_ids),
                    "loops": sum(loop.accepted for loop in slam.snapshot().loops),
                    "prune_ms": percentiles(meter.status().stages_ms.get("prune", [0.0])),
                    "error_m": error_m(slam.snapshot(), per_lap),
                    "recall": round(found / per_lap, 3),
                    "query_ms": percentiles(query_ms),
                    "step_ms": percentiles(step_ms),
                    "rss_mb": round(psutil.Process().memory_info().rss / 1e6),
                    "disk_mb": round((path.stat().st_size) / 1e6, 1),
                }
                rows.append(row)
                print(json.dumps(row), flush=True)
    solver.close()
    return rows


def prune(folder: Path, count: int) -> dict[str, object]:
    """Return how long each part of forgetting AT_ONCE keyframes takes in a map of ten laps with loops between them."""
    path, per_lap = folder / "map.seamark", count // 10
    template = keyframe(0, per_lap, 0, 8)
    ids, T = np.arange(count), np.stack([pose(number, per_lap) for number in range(count)])
    again = range(per_lap, count, 10)
    tight = 1e-4 * np.eye(6)
    loops = [Loop(n, n - per_lap, True, Reason.ACCEPTED, 50, 0.5, 0.5, 0.1, np.eye(4), tight) for n in again]
    config, taken = BackendConfig(map=MapConfig(keyframes=count - 1)), {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        started = time.process_time()
        result = work()
        taken[name] = round(1e3 * (time.process_time() - started))
        return result

    with MapStore(path) as store:
        store.file.database.execute("PRAGMA synchronous = OFF")  # only while the map is made
        for number in range(count):
            previous = number - 1 if number else None
            store.add_keyframe(replace(template, id=number, previous_id=previous, T_odom_cam=T[number]))
        store.record(loops, MapSnapshot(1, ids, ids * 0, ids * 0, T, np.ones(count), ()), {"mapped": str(count - 1)})
        store.file.database.execute("PRAGMA synchronous = FULL")
        slam = Slam(config, Mode.RGBD, SolverProcess(config), 0, loader(store))
        restore(slam, store)
        lightings = timed("lightings, the first time", store.load_lightings)
        views = timed("views", lambda: views_in(slam.snapshot(), lightings))
        pruning = timed("choose", lambda: choose(views, int(0.9 * count), (), config.map, (), AT_ONCE))
        change = timed("contract", lambda: slam.without(pruning.forget))
        timed("write", lambda: store.contract(change))
        timed("adopt", lambda: slam.adopt(change))
    return {"keyframes": count, "loops": len(loops), "forgotten": len(pruning.forget), "cpu_ms": taken}


def service(folder: Path, count: int) -> dict[str, object]:
    """Kill all three processes of a service with a large map; return how long it takes until a place is right again.

    The map is that of a drawn world again and again; the picture asked about is one of its frames.
    """
    small, large = folder / "small.seamark", folder / "map.seamark"
    rig, seed = ToyWorld(5).rig(Mode.RGBD), 5
    frames = [frame for frame in toy_sequence("loop", 120, seed, Mode.RGBD).frames() if isinstance(frame, Frame)]
    settings = NodeSettings(Mode.RGBD, rig, load_config(), map_path=small, log_level="CRITICAL", patient=True)
    with Launcher(settings) as launcher:
        for frame in frames:
            launcher.bus.request(topics.FRAME, frame, 60.0)
        for node in topics.NODES:
            launcher.bus.request(topics.DRAIN[node], Empty(), 60.0)
    with MapStore(small) as store:
        templates, poses = list(store.load_keyframes()), store.load_poses()
        meta = store.meta()
    with MapStore(large) as store:
        store.file.database.execute("PRAGMA synchronous = OFF")  # only here: the file is not what is measured
        T = []
        for number in range(count):
            one = templates[number % len(templates)]
            previous = number - 1 if number else None
            store.add_keyframe(replace(one, id=number, previous_id=previous, session=0, stamp_ns=10**9 * number))
            T.append(poses[one.id][0])
        ids = np.arange(count)
        snapshot = MapSnapshot(1, ids, ids * 0, ids * 0, np.stack(T), np.ones(count), ())
        store.record((), snapshot, meta | {"mapped": str(count - 1), "revision": "1"})
    os.sync()
    asked = templates[len(templates) // 2]
    picture = next(frame.image for frame in frames if frame.file == asked.file)
    query = PlaceQuery(bytes(cv2.imencode(".png", picture)[1]))
    rows = []
    with Launcher(replace(settings, map_path=large)) as launcher:
        for _ in range(3):  # as often as a node is started again
            right_s, status = (
                until_right(launcher, query, asked.file),
                launcher.bus.request(topics.STATUS["vocab"], Empty()),
            )
            rows.append({"s": round(right_s, 2), "described": status.counters.get("places_described_at_start")})
            print(json.dumps(rows[-1]), flush=True)
            killed = [
                child for child in psutil.Process().children() if "seamark.service.nodes" in " ".join(child.cmdline())
            ]
            assert len(killed) == 3
            for child in killed:
                child.kill()
        until_right(launcher, query, asked.file)
        began = time.perf_counter()
    return {"keyframes": count, "until_right": rows, "stop_s": round(time.perf_counter() - began, 2)}


def until_right(launcher: Launcher, query: PlaceQuery, file: str) -> float:
    """Return how long it takes until the service names the place."""
    began = time.perf_counter()
    while True:
        try:
            reply = launcher.bus.request(topics.PLACE, query, 5.0)
            if reply.places and reply.places[0].accepted and reply.places[0].file == file:
                return time.perf_counter() - began
        except SeamarkError:
            launcher.check()
        time.sleep(0.02)


def error_m(snapshot: MapSnapshot, per_lap: int) -> float:
    """Return the RMS error of the kept keyframes' positions after rigid alignment with where they were."""
    true = np.stack([pose(number, per_lap)[:3, 3] for number in snapshot.keyframe_ids.tolist()])
    found = snapshot.T_map_cam[:, :3, 3]
    a, b = true - true.mean(axis=0), found - found.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    turn = (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    return round(float(np.sqrt(((b @ turn.T - a) ** 2).sum(axis=1).mean())), 4)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw each figure over the laps, from zero to its largest value."""
    names = ("rss_mb", "disk_mb", "query_ms", "recall", "nodes", "loops")
    picture = np.full((420, 640, 3), 255, np.uint8)
    for k, name in enumerate(names):
        values = [row[name]["p50"] if isinstance(row[name], dict) else row[name] for row in rows]
        left, bottom = 30 + 205 * (k % 3), 180 + 205 * (k // 3)
        most = max([*values, 1e-9])
        points = [
            (left + 170 * row["lap"] / rows[-1]["lap"], bottom - 130 * v / most)
            for row, v in zip(rows, values, strict=True)
        ]
        cv2.rectangle(picture, (left, bottom - 140), (left + 175, bottom), (180, 180, 180))
        cv2.polylines(picture, [np.array(points).astype(np.int32)], False, (160, 60, 0), 2, cv2.LINE_AA)
        words = f"{name} {values[0]:.4g} .. {values[-1]:.4g}"
        cv2.putText(picture, words, (left, bottom - 148), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.imwrite(str(path), picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("commit", "recover", "prune", "service", "laps"))
    parser.add_argument("--keyframes", type=int, default=500)
    parser.add_argument("--before", type=int, default=0, help="Keyframes that the map has before the commits.")
    parser.add_argument("--laps", type=int, default=50)
    parser.add_argument("--per-lap", type=int, default=25)
    parser.add_argument("--keep", type=int, default=60)
    parser.add_argument("--folder", type=Path, help="Where maps are made; default: the folder for temporary files.")
    parser.add_argument("--plot", type=Path, help="PNG to draw the laps to.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        if options.what == "commit":
            print(json.dumps(commit(Path(folder), options.keyframes, options.before)))
        elif options.what == "recover":
            print(json.dumps(recover(Path(folder), options.keyframes)))
        elif options.what == "prune":
            print(json.dumps(prune(Path(folder), options.keyframes)))
        elif options.what == "service":
            print(json.dumps(service(Path(folder), options.keyframes)))
        else:
            rows = laps(Path(folder), options.laps, options.per_lap, options.keep)
            if options.plot is not None:
                plot(rows, options.plot)


if __name__ == "__main__":
    sys.exit(main())
