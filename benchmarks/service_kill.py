"""A service under load whose processes are killed at random, the launcher included; is anything acknowledged missing?

    .venv/bin/python benchmarks/service_kill.py --kills 100 --seed 1

Frames of a drawn room come in as fast as they are taken. Again and again one of frontend, vocab, backend, solver and
launcher (with its router) is killed with -9, after a random time and before or after the last one's successor is there.
What the service shows in its map or tells of a loop has been acknowledged: all of it must be in the file at the end. A
service that ends by itself must say why; it is started again. Prints one line of JSON; exit code 1: a broken promise.
"""

import argparse
import atexit
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import psutil

from seamark import SeamarkError
from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.types import Frame, Mode
from seamark.service import topics
from seamark.service.nodes.process import ORPHAN_PATIENCE_S
from seamark.service.requests import Empty
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import free_endpoint, open_session

VICTIMS = ("frontend", "vocab", "backend", "solver", "launcher")
WORLD = 5
FRAME_NS = 66_666_667
WINDOW = 4
PATIENCE_S = 90.0  # for the next keyframe after a kill; the machine may be busy
NEW_KEYFRAMES = 3  # more than can have been on their way into the map when a process was killed
STOP_S = 5.0
LONGEST_WAIT_S = 2.5
OPTIONS = ("frontend.keyframe_parallax_px=8", "vocab.exclude_recent_s=2")


def calibration() -> str:
    """Return calib.yaml of the drawn room's camera."""
    rig = ToyWorld(WORLD).rig(Mode.RGBD)
    camera = rig.cam0
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return json.dumps({"model": "pinhole", **values, "depth_factor": rig.depth_factor})


class Load:
    """Sends frames for ever, whoever dies, and notes what the service has acknowledged."""

    def __init__(self, endpoint: str, frames: list[Frame]) -> None:
        self._endpoint, self._frames = endpoint, frames
        self.keyframes: set[int] = set()
        self.loops: set[tuple[int, int]] = set()
        self.answered = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="load")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def newest(self) -> int:
        """Return the number of the newest keyframe that the map has shown."""
        return max(self.keyframes, default=-1)

    def _run(self) -> None:
        count = 0
        while not self._ended.is_set():
            try:
                with open_session("client", connect=[self._endpoint], timeout_s=1.0) as session:
                    bus = ZenohBus(session, topics.RUNNER, "default")
                    try:
                        bus.subscribe(topics.LOOP, lambda loop: self.loops.add((loop.query_id, loop.match_id)))
                        count = self._send(bus, count)
                    finally:
                        bus.close()
            except SeamarkError:
                self._ended.wait(0.1)

    def _send(self, bus: ZenohBus, count: int) -> int:
        pending: deque[Future[Any]] = deque()
        last = 0.0
        while not self._ended.is_set():
            one = self._frames[count % len(self._frames)]
            pending.append(bus.request_async(topics.FRAME, replace(one, index=count, stamp_ns=count * FRAME_NS), 5.0))
            count += 1
            if len(pending) == WINDOW:
                try:
                    pending.popleft().result()
                    self.answered += 1
                except SeamarkError:
                    self._ended.wait(0.1)
                    if not bus.matched(topics.MAP_SNAPSHOT) and not bus.matched(topics.FRAME):
                        return count  # the router has gone, or nobody is there: connect anew
            if time.monotonic() > last + 0.2:
                last = time.monotonic()
                try:
                    snapshot = bus.request(topics.MAP_SNAPSHOT, Empty(), 2.0)
                    self.keyframes |= set(snapshot.keyframe_ids.tolist())
                except SeamarkError:
                    pass
        return count


class Service:
    """`seamark serve` as its users start it, on a map that may be there already."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.map = folder / "map.seamark"
        self._endpoint, self.log = endpoint, folder / "serve.log"
        (folder / "calib.yaml").write_text(calibration(), encoding="utf-8")
        words = [word for option in OPTIONS for word in ("-o", option)]
        self._command = [
            *(str(Path(sys.executable).parent / "seamark"), "serve", "--map", str(self.map)),
            *("--calib", str(folder / "calib.yaml"), "--listen", endpoint, *words),
        ]
        self.process: subprocess.Popen[bytes] | None = None
        self.said: list[str] = []
        self._family: set[psutil.Process] = set()

    def start(self) -> float:
        """Start until it is ready; a refusal (the map is still in use) is tried again. Returns seconds taken."""
        began = time.monotonic()
        while time.monotonic() < began + PATIENCE_S:
            with self.log.open("wb") as log:
                self.process = subprocess.Popen(self._command, stdout=log, stderr=subprocess.STDOUT)
            atexit.register(self.process.terminate)  # where a promise is broken and nobody stops it
            while self.process.poll() is None and time.monotonic() < began + PATIENCE_S:
                if b"seamark serves" in self.log.read_bytes():
                    return time.monotonic() - began
                time.sleep(0.02)
            self.why()
        raise AssertionError(f"no service after {PATIENCE_S} s: {self.said[-3:]}")

    def why(self) -> None:
        """Note why the service has ended; one that does not say has broken a promise."""
        assert self.process is not None and self.process.poll() is not None
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        errors = [line for line in lines if line.startswith("error:")]
        assert errors, f"exit code {self.process.returncode} and no reason: {lines[-5:]}"
        self.said.append(errors[-1])

    def find(self, victim: str) -> psutil.Process | None:
        """Return the process of this name, None where there is none at the moment."""
        assert self.process is not None
        try:
            launcher = psutil.Process(self.process.pid)
            if victim == "launcher":
                return launcher
            for child in launcher.children(recursive=True):
                words = " ".join(child.cmdline())
                self._family.add(child)
                solver = "multiprocessing" in words and "spawn_main" in words
                if (victim == "solver" and solver) or f"seamark.service.nodes.{victim}_node" in words:
                    return child
        except psutil.Error:
            return None
        return None

    def zombies(self) -> list[int]:
        """Return children that have ended and were not waited for, for longer than a second."""
        assert self.process is not None

        def now() -> set[int]:
            try:
                children = psutil.Process(self.process.pid).children(recursive=True)  # type: ignore[union-attr]
                return {child.pid for child in children if child.status() == psutil.STATUS_ZOMBIE}
            except psutil.Error:
                return set()

        first = now()
        if not first:
            return []
        time.sleep(1.0)
        return sorted(first & now())

    def left_over(self) -> list[psutil.Process]:
        """Return processes of earlier services that are still there."""
        return [one for one in self._family if _is_alive(one)]

    def stop(self) -> float:
        """Stop it with SIGTERM and return how long that takes."""
        assert self.process is not None
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(PATIENCE_S)
        return time.monotonic() - began


def _is_alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def until(condition: Callable[[], object], patience_s: float, what: str) -> float:
    """Wait for a condition; returns how long it took."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() < began + patience_s, what
        time.sleep(0.02)
    return time.monotonic() - began


def kill(service: Service, victim: str) -> int | None:
    """Kill a process of the service; a launcher's nodes must follow it. Returns its id, None where there was none."""
    process = service.find(victim)
    if process is None:
        return None
    if victim == "launcher":
        for name in VICTIMS[:-1]:
            service.find(name)  # to know who must follow
    try:
        process.kill()
    except psutil.NoSuchProcess:
        return None
    if victim == "launcher":
        assert service.process is not None
        service.process.wait()
        until(lambda: not service.left_over(), ORPHAN_PATIENCE_S + 5, "nodes outlive their launcher")
    return process.pid


def is_back(service: Service, load: Load, victim: str, dead: int | None, keyframes: int) -> bool:
    """Return whether the killed process has a successor and the map goes on; starts a service that has ended anew."""
    assert service.process is not None
    if service.process.poll() is not None:
        if service.process.returncode != -signal.SIGKILL:
            service.why()
        service.start()
    successor = service.find(victim)
    return successor is not None and successor.pid != dead and len(load.keyframes) >= keyframes


def torment(folder: Path, kills: int, seed: int) -> dict[str, object]:
    """Kill so many times; return what was seen. Raises AssertionError for a broken promise."""
    rng = random.Random(seed)
    frames = [one for one in toy_sequence("loop", 120, WORLD, Mode.RGBD).frames() if isinstance(one, Frame)]
    endpoint = free_endpoint()
    service, killed = Service(folder, endpoint), Counter[str]()
    back_s: dict[str, list[float]] = {}
    service.start()
    with Load(endpoint, frames) as load:
        until(lambda: load.newest() >= 3, PATIENCE_S, "no keyframe at all")
        while killed.total() < kills:
            time.sleep(rng.uniform(0, LONGEST_WAIT_S))
            victim = rng.choice(VICTIMS)
            assert service.process is not None
            dead = kill(service, victim)
            if dead is None and service.process.poll() is None:
                continue
            began, before = time.monotonic(), len(load.keyframes)
            killed[victim] += 1
            if victim != "launcher" and rng.random() < 0.3:
                continue  # the next one dies before this one's successor is there
            lives = partial(is_back, service, load, victim, dead, before + NEW_KEYFRAMES)
            until(lives, PATIENCE_S, f"no keyframe after the {victim} was killed; see {service.log}")
            back_s.setdefault(victim, []).append(time.monotonic() - began)
            assert not service.zombies(), "zombies"
        if service.process is not None and service.process.poll() is not None:
            service.start()
        stop_s = service.stop()
        code = service.process.returncode if service.process else None
    assert stop_s < STOP_S, f"stopping took {stop_s:.1f} s"
    assert code == 0, f"exit code {code} when stopped"
    until(lambda: not service.left_over(), 5, "processes are left over")
    report = {"killed": dict(killed), "answered": load.answered, "said": Counter(service.said)}
    report |= {"keyframes": len(load.keyframes), "loops": len(load.loops), "stop_s": round(stop_s, 2)}
    report |= {"back_s": {name: [round(min(s), 2), round(max(s), 2)] for name, s in sorted(back_s.items())}}
    return report | missing(service.map, load)


def missing(path: Path, load: Load) -> dict[str, object]:
    """Compare the file with what was acknowledged; nothing is pruned here."""
    problems = check_map(path).problems
    assert not problems, problems[:3]
    with MapStore(path, read_only=True) as store:
        kept = set(store.keyframe_ids())
        rows = {(loop.query_id, loop.match_id) for loop in store.load_loops()}
    return {"in_file": len(kept), "lost": sorted(load.keyframes - kept), "lost_loops": sorted(load.loops - rows)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="Where the map is made; default: a folder for temporary files.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        report = torment(Path(folder), options.kills, options.seed)
    print(json.dumps(report))
    return int(bool(report["lost"] or report["lost_loops"]))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
