"""Localisation only: the service answers from the map and leaves it as it is, to the byte."""

from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from seamark.backend.errors import MapError
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame, Mode
from seamark.service import topics
from seamark.service.config import load_config
from seamark.service.launcher import Launcher, NodeFailedError
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceQuery
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
    before = {one.name: (one.read_bytes(), one.stat().st_mtime_ns) for one in folder.iterdir()}
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
    assert {one.name: (one.read_bytes(), one.stat().st_mtime_ns) for one in folder.iterdir()} == before


def test_serve_says_at_once_that_there_is_no_map_to_localise_in(tmp_path: Path) -> None:
    options = ServeOptions(None, None, tmp_path / "no.seamark", None, "tcp/127.0.0.1:0", None, "x", localise_only=True)
    with pytest.raises(MapError, match="there is no map"):
        serve(options, load_config(), lambda *_: None)
    assert list(tmp_path.iterdir()) == []
