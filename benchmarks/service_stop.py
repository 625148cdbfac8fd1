"""How long a service takes to stop while frames come in, on an idle machine or beside programs that never pause.

    .venv/bin/python benchmarks/service_stop.py SOURCE [--map MAP] [--stops 8] [--busy 4]

SOURCE is an RGB-D sequence with a calib.yaml; MAP is the service's map, by default a new one, and grows. After a random
time the service gets SIGTERM; printed is the wall time until its process has ended. Exit code 1: one took 5 s or more.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SEAMARK = str(Path(sys.executable).parent / "seamark")
STOP_S = 5.0


def stop_once(source: Path, map_path: Path, wait_s: float, port: int) -> tuple[float, list[str]]:
    """Return how long a stop took after a while under load, and what the service said about it."""
    endpoint = f"tcp/127.0.0.1:{port}"
    arguments = ("--map", map_path, "--mode", "rgbd", "--calib", source / "calib.yaml", "--listen", endpoint)
    service = subprocess.Popen(
        [SEAMARK, "serve", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert service.stdout is not None
    service.stdout.readline()  # it serves
    feed = subprocess.Popen(
        [SEAMARK, "feed", str(source), "--connect", endpoint], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    time.sleep(wait_s)
    began = time.monotonic()
    service.send_signal(signal.SIGTERM)
    service.wait()
    took_s = time.monotonic() - began
    feed.kill()
    feed.wait()
    return took_s, service.stdout.read().splitlines()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--stops", type=int, default=8)
    parser.add_argument("--busy", type=int, default=0, help="programs beside it that never pause")
    parser.add_argument("--port", type=int, default=7600)
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(given.busy)]
    took = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for number in range(given.stops):
                path = given.map or Path(folder) / "map.seamark"
                seconds, said = stop_once(given.source, path, rng.uniform(3, 30), given.port + number)
                took.append(seconds)
                print(f"{seconds:.2f} s  {'; '.join(said)}", flush=True)
    finally:
        for program in busy:
            program.kill()
    print(f"{len(took)} stops: {min(took):.2f} to {max(took):.2f} s")
    sys.exit(max(took) >= STOP_S)


if __name__ == "__main__":
    main()
