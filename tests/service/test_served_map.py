"""A map that a service has open: others are refused or read beside it, and it stays within its budgets."""

import json
import subprocess
import sys
from collections.abc import Iterator
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
from seamark.service.launcher import Launcher, NodeFailedError
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceQuery
from seamark.vocab.training import train

pytestmark = pytest.mark.zenoh
SEED = 5
PATIENCE_S = 60.0
FRAME_NS = 66_666_667
LAP = 90
KEYFRAMES, DISK_MB, MEMORY_MB = 30, 6, 1
LOOK_EVERY = 20  # keyframes; so many come between two looks at a budget, and so many of the newest are spared


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(toy_sequence("loop", LAP, SEED, Mode.RGBD).frames())


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory, frames: list[Frame]) -> NodeSettings:
    words = tmp_path_factory.mktemp("vocabulary") / "words"
    train((extract_features(frame.image, 300).descriptors for frame in frames[:8]), 256, 0).save(words)
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "vocab.exclude_recent_s=2"])
    rig = ToyWorld(SEED).rig(Mode.RGBD)
    return NodeSettings(Mode.RGBD, rig, config, vocabulary=words, patient=True, log_level="CRITICAL")


def feed(launcher: Launcher, frames: list[Frame], laps: int = 1) -> None:
    for lap in range(laps):
        for frame in frames:
            index = lap * LAP + frame.index
            launcher.bus.request(topics.FRAME, replace(frame, index=index, stamp_ns=index * FRAME_NS), PATIENCE_S)
    for node in topics.NODES:
        launcher.bus.request(topics.DRAIN[node], Empty(), PATIENCE_S)


def counters(launcher: Launcher) -> dict[str, int]:
    status = launcher.bus.request(topics.STATUS["backend"], Empty(), PATIENCE_S)
    return dict(status.counters)


@pytest.fixture(scope="module")
def served(
    settings: NodeSettings, frames: list[Frame], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Launcher, NodeSettings]]:
    mine = replace(settings, map_path=tmp_path_factory.mktemp("map") / "map.seamark")
    with Launcher(mine) as launcher:
        feed(launcher, frames[:40])
        yield launcher, mine


def seamark(*words: object) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / "seamark"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_writers_are_refused_and_the_service_goes_on(
    served: tuple[Launcher, NodeSettings], frames: list[Frame]
) -> None:
    """Test: everything that writes a map, on one that is served. Expected: a sentence, exit code 1, nothing changed."""
    launcher, settings = served
    path = settings.map_path
    assert path is not None
    before = counters(launcher)["keyframes"]
    for words in (
        ("serve", "--map", path, "--mode", "places", "--listen", "tcp/127.0.0.1:0"),
        ("map", "prune", path, "--keyframes", 5),
        ("map", "optimise", path, "--full"),
    ):
        refused = seamark(*words)
        assert refused.returncode == 1 and refused.stdout == ""
        assert "is in use by another process, which writes it" in refused.stderr
        assert refused.stderr.count("\n") == 1 and refused.stderr.startswith("error: ")
    with pytest.raises(NodeFailedError, match="is in use by another process, which writes it"), Launcher(settings):
        pass
    feed(launcher, frames[40:])
    after = counters(launcher)
    assert after["keyframes"] > before and after["learning"] == 1 and "map_unwritable" not in after
    with MapStore(path, read_only=True) as store:
        assert len(store.keyframe_ids()) == after["keyframes"]


def test_readers_read_beside_the_service(served: tuple[Launcher, NodeSettings], tmp_path: Path) -> None:
    launcher, settings = served
    path = settings.map_path
    stored = counters(launcher)["keyframes"]
    info = seamark("map", "info", path, "--json")
    assert json.loads(info.stdout)["rows"]["keyframes"] == stored
    assert seamark("map", "check", path).returncode == 0
    assert seamark("map", "export", path, "--out", tmp_path / "map.tum").returncode == 0
    assert len((tmp_path / "map.tum").read_text().splitlines()) == stored
    backup = seamark("map", "backup", path, "--out", tmp_path / "copy.seamark")
    assert backup.returncode == 0
    assert check_map(tmp_path / "copy.seamark").problems == ()
    with MapStore(tmp_path / "copy.seamark", read_only=True) as store:
        assert len(store.keyframe_ids()) == stored
    assert [one.name for one in tmp_path.iterdir() if "seamark" in one.name] == ["copy.seamark"]


@pytest.mark.parametrize("budget", ["keyframes", "disk"])
def test_a_running_service_keeps_its_budgets(
    settings: NodeSettings, frames: list[Frame], tmp_path: Path, budget: str
) -> None:
    """Test: the same way driven three times. Expected: file and memory are bounded, and places still recognised."""
    path = tmp_path / "map.seamark"
    limit = f"keyframes={KEYFRAMES}" if budget == "keyframes" else f"disk_mb={DISK_MB}"
    overrides = [f"backend.map.{limit}", f"backend.map.memory_mb={MEMORY_MB}", "frontend.keyframe_parallax_px=8"]
    config = load_config(overrides=[*overrides, "vocab.exclude_recent_s=2"])
    with Launcher(replace(settings, map_path=path, config=config)) as launcher:
        feed(launcher, frames, laps=3)
        found = counters(launcher)
        for number in (10, 40, 70):
            query = PlaceQuery(bytes(cv2.imencode(".png", frames[number].image)[1]))
            assert launcher.bus.request(topics.PLACE, query, PATIENCE_S).places[0].accepted
    with MapStore(path, read_only=True) as store:
        kept, used = len(store.keyframe_ids()), store.bytes_used()
    most_kept, most_bytes = (KEYFRAMES, used) if budget == "keyframes" else (kept, DISK_MB << 20)
    assert 0.5 * most_kept < kept <= most_kept + LOOK_EVERY
    assert 0.5 * most_bytes < used <= most_bytes + LOOK_EVERY * used / kept
    assert found["views_forgotten"] == found["keyframes"] - kept > LOOK_EVERY
    assert 0.5 < found["feature_bytes"] / (MEMORY_MB << 20) <= 1
    assert 0 < found["map_bytes"] <= used
