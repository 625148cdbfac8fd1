"""How long the vocabulary's process takes to start on an old map, with and without the place index kept beside it.

    .venv/bin/python benchmarks/vocab_start.py [--keyframes 10000] [--folder DIR]

Keyframes are those of backend_map.py: 800 features and a JPEG of 60 kB each, 200 places again and again. Each start is
a new process, from its first instruction until it has answered one place query; its own seconds of CPU stand beside.
The map is in the system's cache, as after a crash of the process alone.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from backend_map import keyframe, pose

from seamark.backend.map_store import MapStore

PLACES = 200
CHILD = """
import sys, time
from pathlib import Path
from seamark.backend.map_store import MapStore
from seamark.frontend.types import Mode
from seamark.service import topics
from seamark.service.bus import LocalBus
from seamark.service.nodes import vocab_node
from seamark.service.nodes.settings import NodeSettings

path, localise_only = Path(sys.argv[1]), sys.argv[2] == "reading"
settings = NodeSettings(Mode.RGBD, map_path=path, restore=True, patient=True, localise_only=localise_only)
bus = LocalBus("asks")
node = vocab_node.build(bus.for_node("vocab"), settings)
with MapStore(path, read_only=True) as store:
    asked = vocab_node.observe(store.keyframe(7))
assert bus.request(topics.PLACES_RANK, asked).ranked
print(f"{time.process_time():.2f}", flush=True)
sys.stdin.readline()
node.stop()
node.close()
"""


def make_map(path: Path, count: int) -> None:
    templates = [keyframe(number, PLACES) for number in range(PLACES)]
    with MapStore(path) as store:
        store.file.database.execute("PRAGMA synchronous = OFF")  # only here: the file is not what is measured
        for number in range(count):
            seen = templates[number % PLACES]
            following = number - 1 if number else None
            T, stamp_ns = pose(number, PLACES), 10**9 * number
            store.add_keyframe(replace(seen, id=number, previous_id=following, T_odom_cam=T, stamp_ns=stamp_ns))


def start(path: Path, how: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    began = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), how],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
    ) as child:
        assert child.stdin is not None and child.stdout is not None
        cpu_s, wall_s = child.stdout.readline().strip(), time.perf_counter() - began
        began = time.perf_counter()
        child.stdin.close()
        child.wait()
    stopped_s = time.perf_counter() - began
    cached = sum(file.stat().st_size for file in path.parent.iterdir() if file.name.endswith(".places"))
    print(f"| {how} | {wall_s:.2f} | {cpu_s} | {stopped_s:.2f} | {cached / 2**20:.0f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="where the map is made, or is already")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        path = (options.folder or Path(temporary)) / "map.seamark"
        if not path.exists():
            make_map(path, options.keyframes)
        print("| | until a query is answered, s | CPU s | stopping s | places file MiB |\n|---|---|---|---|---|")
        for how in ("reading", "learning", "learning", "reading"):
            start(path, how)


if __name__ == "__main__":
    main()
