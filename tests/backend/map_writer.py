"""A process that makes writers to be killed: forked from here, where everything is imported, they start at once.

Usage: ``map_writer.py PATH SEED``. Each life a child opens the map, reports ``open``, writes, and reports each
number once it is acknowledged; after a random time it is killed with SIGKILL. Prints one JSON line per life: the
numbers that were acknowledged, and whether the child came as far as to open the map. The test that started this process
looks at the file in between: a life begins when a line is read from standard input.
"""

import json
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.config import BackendConfig
from seamark.backend.contraction import contract
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.map_contraction import contracted
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend.types import Features, Keyframe

LONGEST_WAIT_NUMBERS = 1.5  # in the time that one number takes on this disk
MOST_LINES = 3  # before the wait begins
FORGET_AFTER = 20


def keyframe(number: int) -> Keyframe:
    """Return a keyframe whose every byte follows from its number."""
    rng = np.random.default_rng(number)
    count = 3 + number % 20
    T = np.eye(4)
    T[:3, 3] = rng.normal(size=3)
    points = rng.normal(size=(count, 2)).astype(np.float32)
    scales = np.full(count, number, np.float32)
    descriptors = rng.integers(0, 256, (count, 128)).astype(np.uint8)
    return Keyframe(
        id=number,
        session=number // 100,
        index=number,
        stamp_ns=number,
        file=str(number),
        features=Features(points, scales, scales, descriptors),
        landmarks=rng.normal(size=(count, 3)).astype(np.float32),
        thumbnail=np.full((2, 2), number % 256, np.uint8),
        jpeg=rng.bytes(10 + number % 7 * 1500),
        previous_id=number - 1 if number % 100 else None,
        T_odom_cam=T,
        covariance=np.eye(6) * (number + 1),
        depth=rng.bytes(500 + number % 5 * 2000),
    )


def loop(query: int, match: int) -> Loop:
    """Return a loop that says by its inliers whose it is."""
    return Loop(query, match, True, Reason.ACCEPTED, query, 0.5, 0.25, 0.125, np.eye(4), np.eye(6))


def forget(store: MapStore, newest: int) -> None:
    """Take keyframes out of the map, as pruning does: two loops become one, the successor starts the chain."""
    keyframes = [store.keyframe(one) for one in store.keyframe_ids()]
    nodes = [Node(k.id, k.session, k.previous_id, k.T_odom_cam, k.covariance) for k in keyframes]  # type: ignore[arg-type]
    loops = {(one.query_id, one.match_id): one for one in store.load_loops()}
    constraints = [Constraint(*key, one.T_match_query, one.covariance) for key, one in loops.items()]  # type: ignore[arg-type]
    graph = contract(nodes, constraints, [node.id for node in nodes if node.id <= newest], BackendConfig().drift)
    components = {session.id: session.component for session in store.load_sessions()}
    store.contract(contracted(graph, loops, components, store.load_adjustments()))


def write(path: Path, acknowledge: int) -> None:
    """Go on where the file ends: a keyframe, its loop, now and then poses and something forgotten."""
    store = MapStore(path)
    store.file.database.execute("PRAGMA wal_autocheckpoint = 30")
    os.write(acknowledge, b"open\n")
    number = max(store.keyframe_ids(), default=-1) + 1
    while True:
        store.add_keyframe(keyframe(number))
        if number:
            loops = [loop(number, number - gap) for gap in (1, 3) if number >= gap + max(0, number - FORGET_AFTER)]
            snapshot, adjustments = None, []
            if number % 5 == 0:
                ids = np.arange(max(0, number - 10), number + 1)
                T = np.tile(np.eye(4), (len(ids), 1, 1))
                T[:, 0, 3] = number
                snapshot = MapSnapshot(number, ids, ids // 100, ids * 0, T, np.ones(len(ids)), ())
                poses = {n: AdjustedPose(T[0], 1.0, None, None) for n in ids.tolist() if n > number - FORGET_AFTER}
                adjustments = [Adjustment(min(poses), poses, {(x.query_id, x.match_id): 1.0 for x in loops})]
            store.record(loops, snapshot, {"mapped": str(number)}, adjustments)
        if number >= FORGET_AFTER:
            forget(store, number - FORGET_AFTER)
        os.write(acknowledge, f"{number}\n".encode())
        number += 1


def life(path: Path, delay_s: float, lines: int) -> dict[str, object]:
    """Fork a writer, kill it some time after it has said so many lines; return what it had acknowledged."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            write(path, writer)
        finally:
            os._exit(1)
    os.close(writer)
    said = b""
    while said.count(b"\n") < lines:
        said += os.read(reader, 64)
    time.sleep(delay_s)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with os.fdopen(reader) as stream:
        words = (said.decode() + stream.read()).split()
    return {
        "open": "open" in words,
        "numbers": [int(word) for word in words if word != "open"],
        "killed": os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL,
    }


def time_per_number_s(path: Path) -> float:
    """Let a writer live until it has written ten numbers to a map of its own."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        write(path, writer)
    os.close(writer)
    with os.fdopen(reader) as stream:
        stream.readline()
        started = time.perf_counter()
        for _ in range(10):
            stream.readline()
        taken = (time.perf_counter() - started) / 10
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return taken


def main() -> None:
    path, rng = Path(sys.argv[1]), random.Random(int(sys.argv[2]))
    with tempfile.TemporaryDirectory() as folder:
        longest_s = LONGEST_WAIT_NUMBERS * time_per_number_s(Path(folder) / "trial.seamark")
    for _ in sys.stdin:
        print(json.dumps(life(path, rng.uniform(0, longest_s), rng.randint(0, MOST_LINES))), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
