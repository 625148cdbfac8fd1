"""Localisation only: the service answers from the map and leaves it as it is, to the byte."""

import csv
import os
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.backend.errors import MapError
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame, Mode
from seamark.service import topics, trajectories
from seamark.service.config import load_config
from seamark.service.launcher import Launcher, NodeFailedError
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceQuery
from seamark.service.run import RunOptions, run
from seamark.service.serve import ServeOptions, serve
from seamark.vocab.training import train

SEED = 5


@pytest.mark.zenoh
def test_a_service_that_only_localises_never_writes(tmp_path: Path) -> None:
    frames: list[Frame] = list(toy_sequence("loop", 40, SEED, Mode.RGBD).frames())
    vocabulary, folder = tmp_path / "words", tmp_path / "map"
    folder.mkdir()
    path = folder / "map.seamark"
    train((extract_features(frame.image, 300).descriptors for frame in frames[:8]), 256, 0).save(vocabulary)
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "backend.map.memory_mb=1"])
    rig = ToyWorld(SEED).rig(Mode.RGBD)
    settings = NodeSettings(Mode.RGBD, rig, config, vocabulary=vocabulary, map_path=path, log_level="CRITICAL")
    with pytest.raises(NodeFailedError, match="there is no map"), Launcher(replace(settings, localise_only=True)):
        pass
    with Launcher(settings) as launcher:
        for frame in frames:
            launcher.bus.request(topics.FRAME, frame, 60.0)
        for node in topics.NODES:
            launcher.bus.request(topics.DRAIN[node], Empty(), 60.0)
    before = contents(folder)
    with Launcher(replace(settings, localise_only=True)) as launcher:
        odometry = [launcher.bus.request(topics.FRAME, frame, 60.0) for frame in frames]
        for number in (4, 20, 33):
            query = PlaceQuery(bytes(cv2.imencode(".png", frames[number].image)[1]))
            reply = launcher.bus.request(topics.PLACE, query, 60.0)
            assert reply.places[0].accepted and reply.places[0].T_map_cam is not None
            assert abs(reply.places[0].stamp_ns - frames[number].stamp_ns) < 2_000_000_000
        counters = launcher.bus.request(topics.STATUS["backend"], Empty()).counters
        assert counters["learning"] == 0 and "keyframes" not in counters
        left_out = launcher.bus.request(topics.STATUS["frontend"], Empty()).counters["keyframes_left_out"]
        assert 2 < left_out <= sum(one.keyframe_id is not None for one in odometry)
        assert {one.name for one in folder.iterdir()} == set(before)
    assert contents(folder) == before


@pytest.mark.zenoh
def test_a_run_that_only_localises_finds_its_frames_in_an_old_map(tmp_path: Path) -> None:
    """Test: the way of the map driven again, through a frame of its own. Expected: poses of the map, which stays."""
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "service.record=false"])
    old = tmp_path / "old"
    first = run(toy_sequence("loop", 40, SEED, Mode.RGBD), RunOptions(old, ("toy",), in_process=True), config)
    path, before = old / "map.seamark", contents(old)
    sequence = toy_sequence("loop", 40, SEED, Mode.RGBD)
    options = RunOptions(tmp_path / "new", ("toy",), map_path=path, localise_only=True)
    second = run(sequence, options, config)
    assert contents(old) == before
    assert "map.seamark" not in contents(tmp_path / "new")
    # The poses of the map are what they were, but for rounding, and the session lies in its frame.
    count = len(first.snapshot.keyframe_ids)
    assert len(second.keyframes) > 3 and min(one.id for one in second.keyframes) == count
    np.testing.assert_allclose(second.snapshot.T_map_cam[:count], first.snapshot.T_map_cam, rtol=0, atol=1e-12)
    assert set(second.snapshot.components.tolist()) == {0} and set(second.snapshot.sessions.tolist()) == {0, 1}
    assert all(loop.match_id < count for loop in second.snapshot.loops)
    there, here = trajectories.corrected(first), trajectories.corrected(second)
    assert len(here) == len(there) == 40
    apart = np.linalg.norm(here.T_world_cam[:, :3, 3] - there.T_world_cam[:, :3, 3], axis=1)
    assert 0 < apart.max() < 0.05


@pytest.mark.zenoh
def test_a_back_end_that_dies_takes_nothing_of_a_passing_session_with_it(tmp_path: Path) -> None:
    """Test: the back end is killed in the midst of the same way through an old map. Expected: all keyframes, at the
    poses that the old ones of the same frames have, and loops from before the kill and after it.
    """
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "service.record=false"])
    sequence, options = (
        toy_sequence("loop", 40, SEED, Mode.RGBD),
        RunOptions(tmp_path / "old", ("toy",), in_process=True),
    )
    first = run(sequence, options, config).snapshot
    path, count, before = tmp_path / "old" / "map.seamark", len(first.keyframe_ids), contents(tmp_path / "old")
    settings = NodeSettings(
        Mode.RGBD,
        ToyWorld(SEED).rig(Mode.RGBD),
        config,
        map_path=path,
        localise_only=True,
        passing_path=tmp_path / "passing",
        log_level="ERROR",
    )
    odometry = []
    with Launcher(settings) as launcher:
        for frame in toy_sequence("loop", 40, SEED, Mode.RGBD).frames():
            if frame.index == 25:
                killed_at = max(one.keyframe_id or 0 for one in odometry)
                os.kill(launcher.process_id("backend"), signal.SIGKILL)
            odometry.append(launcher.bus.request(topics.FRAME, frame, 60.0))
        launcher.wait_until_alive()
        for node in topics.NODES:
            launcher.bus.request(topics.DRAIN[node], Empty(), 60.0)
        found = launcher.bus.request(topics.MAP_SNAPSHOT, Empty())
        assert launcher.restarts["backend"] == 1
    own = [one.keyframe_id for one in odometry if one.keyframe_id is not None]
    assert found.keyframe_ids.tolist() == [*range(count), *own] and len(own) == count
    assert set(found.components.tolist()) == {0}
    np.testing.assert_allclose(found.T_map_cam[:count], first.T_map_cam, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.T_map_cam[count:], first.T_map_cam, atol=0.02)
    queries = [one.query_id for one in found.loops if one.accepted and one.query_id >= count]
    assert min(queries) <= killed_at < max(queries)
    assert contents(tmp_path / "old") == before


def test_a_mono_run_that_only_localises_knows_the_keyframe_that_a_session_began_with(tmp_path: Path) -> None:
    """Test: the first view becomes a keyframe when the second one does. Expected: none is missing, each is named."""
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "service.record=false"])
    runs = []
    for name, way in (("old", {}), ("new", {"map_path": tmp_path / "old" / "map.seamark", "localise_only": True})):
        options = RunOptions(tmp_path / name, ("toy",), in_process=True, **way)  # type: ignore[arg-type]
        runs.append(run(toy_sequence("loop", 24, SEED, Mode.MONO), options, config))
    first, second = runs
    count = len(first.keyframes)
    assert [one.id for one in second.keyframes] == [one.id + count for one in first.keyframes]
    assert [(one.index, one.stamp_ns, one.file) for one in second.keyframes] == [
        (one.index, one.stamp_ns, one.file) for one in first.keyframes
    ]
    assert count >= 2
    names = {one.file for one in first.keyframes}
    with (tmp_path / "new" / "loops.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["query_file"] in names]
    assert rows and all(row["match_file"] in names and float(row["match_stamp"]) > 0 for row in rows)


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {one.name: (one.read_bytes(), one.stat().st_mtime_ns) for one in folder.iterdir()}


def test_a_run_cannot_localise_without_a_map(tmp_path: Path) -> None:
    options = RunOptions(tmp_path / "new", ("toy",), in_process=True, localise_only=True)
    with pytest.raises(MapError, match="a map is needed"):
        run(toy_sequence("loop", 3, SEED, Mode.RGBD), options, load_config())
    assert list(tmp_path.iterdir()) == []


def test_serve_says_at_once_that_there_is_no_map_to_localise_in(tmp_path: Path) -> None:
    options = ServeOptions(None, None, tmp_path / "no.seamark", None, "tcp/127.0.0.1:0", None, "x", localise_only=True)
    with pytest.raises(MapError, match="there is no map"):
        serve(options, load_config(), lambda *_: None)
    assert list(tmp_path.iterdir()) == []
