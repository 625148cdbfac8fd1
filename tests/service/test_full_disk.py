"""The real service on a disk that is full, and one that can only be read: it answers, and learns when it can again."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame, Mode
from seamark.service import topics
from seamark.service.config import load_config
from seamark.service.launcher import Launcher
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceQuery, PlaceReply
from seamark.service.run import RunOptions, run
from seamark.vocab.training import train

pytestmark = pytest.mark.zenoh
SEED = 5
PATIENCE_S = 60.0
DISK_BYTES = 24 << 20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("needs the right to mount")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(toy_sequence("loop", 70, SEED, Mode.RGBD).frames())


@pytest.fixture(scope="module")
def vocabulary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vocabulary") / "words"
    other = toy_sequence("turn", 10, SEED + 1).frames()
    train((extract_features(frame.image, 300).descriptors for frame in other), 256, 0).save(path)
    return path


@pytest.fixture
def settings(vocabulary: Path, disk: Path) -> NodeSettings:
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "vocab.exclude_recent_s=2"])
    rig = ToyWorld(SEED).rig(Mode.RGBD)
    return NodeSettings(
        Mode.RGBD, rig, config, vocabulary=vocabulary, map_path=disk / "map.seamark", patient=True, log_level="CRITICAL"
    )


def feed(launcher: Launcher, frames: list[Frame]) -> list[int]:
    odometry = [launcher.bus.request(topics.FRAME, frame, PATIENCE_S) for frame in frames]
    return [one.keyframe_id for one in odometry if one.keyframe_id is not None]


def counter(launcher: Launcher, name: str) -> int:
    return int(launcher.bus.request(topics.STATUS["backend"], Empty()).counters.get(name, 0))


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def ask(launcher: Launcher, frame: Frame) -> PlaceReply:
    encoded = bytes(cv2.imencode(".png", frame.image)[1])
    reply: PlaceReply = launcher.bus.request(topics.PLACE, PlaceQuery(encoded), PATIENCE_S)
    return reply


def drain(launcher: Launcher) -> None:
    for node in topics.NODES:
        launcher.bus.request(topics.DRAIN[node], Empty(), PATIENCE_S)


def test_a_full_disk_stops_learning_until_there_is_room(
    settings: NodeSettings, disk: Path, frames: list[Frame]
) -> None:
    """Test: the disk fills up in mid-run. Expected: queries are answered, odometry goes on."""
    path, filler = disk / "map.seamark", disk / "filler"
    many = load_config(overrides=["frontend.keyframe_parallax_px=4", "vocab.exclude_recent_s=2"])  # beyond the window
    with Launcher(replace(settings, config=many)) as launcher:
        sent = feed(launcher, frames[:20])
        drain(launcher)  # features are made beside the tracking, and may wait for the next frame
        assert counter(launcher, "keyframes") >= 3
        assert counter(launcher, "learning") == 1
        with filler.open("wb", buffering=0) as file, pytest.raises(OSError):
            while True:
                file.write(bytes(4096))
        sent += feed(launcher, frames[20:60])
        until(lambda: counter(launcher, "learning") == 0)
        known = counter(launcher, "keyframes")
        assert 0 < known < len(sent)
        reply = ask(launcher, frames[3])
        assert reply.error_code is None and reply.places[0].accepted
        filler.unlink()
        until(lambda: counter(launcher, "learning") == 1)
        drain(launcher)  # what waited for room is sent before there is more
        sent += feed(launcher, frames[60:])
        drain(launcher)
        left_out = launcher.bus.request(topics.STATUS["frontend"], Empty()).counters.get("keyframes_left_out", 0)
        assert counter(launcher, "keyframes") == len(sent) - left_out
        assert counter(launcher, "map_unwritable") >= 1 and left_out > 0
    assert check_map(path).problems == ()
    with MapStore(path) as store:
        kept = store.keyframe_ids()
        assert set(kept) < set(sent) and len(kept) == len(sent) - left_out
        assert store.meta()["mapped"] == str(sent[-1]) == str(kept[-1])
        nodes = store.load_nodes()
        assert [node.previous_id for node in nodes] == [None, *kept[:-1]]


def test_a_map_on_a_read_only_disk_is_answered_from(settings: NodeSettings, disk: Path, frames: list[Frame]) -> None:
    path = disk / "map.seamark"
    with Launcher(settings) as launcher:
        before = feed(launcher, frames[:20])
        drain(launcher)
    content = path.read_bytes()

    def remount(mode: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{mode},size={DISK_BYTES}", str(disk)], check=True, capture_output=True)

    remount("ro")
    try:
        with Launcher(replace(settings, restore=True)) as launcher:
            assert counter(launcher, "learning") == 0
            assert counter(launcher, "keyframes_restored") == len(before)
            after = feed(launcher, frames[20:50])
            assert ask(launcher, frames[3]).places[0].accepted
            assert path.read_bytes() == content
            remount("rw")
            until(lambda: counter(launcher, "learning") == 1)
            drain(launcher)
    finally:
        remount("rw")
    with MapStore(path) as store:
        assert store.keyframe_ids() == [*before, *after]


def test_commands_on_a_full_disk_say_so_and_leave_nothing(disk: Path, map_of_a_run: Path) -> None:
    """Test: no room for anything, then for little. Expected: a sentence and exit code 1; pruning goes through."""
    path, filler = disk / "map.seamark", disk / "filler"
    shutil.copy(map_of_a_run, path)
    with filler.open("wb", buffering=0) as file, pytest.raises(OSError):
        while True:
            file.write(bytes(4096))
    content = path.read_bytes()
    commands = [("prune", path, "--keyframes", 5), ("optimise", path, "--full")]
    commands += [("backup", path, "--out", disk / "b.seamark"), ("repair", path, "--out", disk / "r.seamark")]
    commands += [("export", path, "--out", disk / "x", "--format", name) for name in ("tum", "g2o", "colmap", "ply")]
    for words in commands:
        done = seamark(*words)
        assert done.returncode == 1 and done.stdout == ""
        last = done.stderr.splitlines()[-1]
        assert last.startswith("error: ") and ("No space left" in last or "no space left" in last), done.stderr
        assert path.read_bytes() == content
        assert {one.name for one in disk.iterdir()} <= {"map.seamark", "map.seamark-wal", "map.seamark-shm", "filler"}
    with filler.open("r+b") as file:
        file.truncate(filler.stat().st_size - (1 << 20))
    wide = ("place_m=100", "place_deg=179", "lighting=1")
    everything = [word for name in wide for word in ("-o", f"backend.map.{name}")]
    pruned = seamark("prune", path, "--keyframes", 5, *everything)
    assert pruned.returncode == 0 and "5 kept" in pruned.stdout and "is used again" in pruned.stderr
    assert check_map(path).problems == ()
    with MapStore(path, read_only=True) as store:
        assert len(store.keyframe_ids()) == 5
    assert path.stat().st_size == len(content)


def seamark(*words: object) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / "seamark"), "map", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.fixture(scope="module")
def map_of_a_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "service.record=false"])
    run(toy_sequence("loop", 60, SEED, Mode.RGBD), RunOptions(folder, ("toy",), in_process=True), config)
    return folder / "map.seamark"
