"""SIGTERM in the middle of the work: over in less than five seconds, with all that was acknowledged in the map."""

import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame, Mode
from seamark.service import topics
from seamark.service.bus import BusError
from seamark.service.config import load_config
from seamark.service.launcher import STOP_TIMEOUT_S, Launcher
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty
from seamark.vocab.training import train

pytestmark = pytest.mark.zenoh
SEED = 5
SLACK_S = 0.5


@pytest.mark.parametrize("stall", [False, True])
def test_a_loaded_service_stops_in_time_and_keeps_what_it_acknowledged(tmp_path: Path, stall: bool) -> None:
    """Test: frames are coming; with ``stall`` one node does not listen either. Expected: see above, and a whole map,
    to which the next service adds what had no candidates.
    """
    frames: list[Frame] = list(toy_sequence("loop", 90, SEED, Mode.RGBD).frames())
    vocabulary = tmp_path / "words"
    train((extract_features(frame.image, 300).descriptors for frame in frames[:8]), 256, 0).save(vocabulary)
    config = load_config(overrides=["frontend.keyframe_parallax_px=4", "vocab.exclude_recent_s=2"])
    path = tmp_path / "map.seamark"
    settings = NodeSettings(
        Mode.RGBD,
        ToyWorld(SEED).rig(Mode.RGBD),
        config,
        vocabulary=vocabulary,
        map_path=path,
        patient=True,
        log_level="CRITICAL",
    )
    with Launcher(settings) as launcher:
        ended: list[str] = []

        def send() -> None:
            try:
                for frame in frames:
                    launcher.bus.request(topics.FRAME, frame, 10.0)
            except BusError as error:
                ended.append(str(error))  # it stops

        sender = threading.Thread(target=send)
        sender.start()
        acknowledged = 0
        while acknowledged < 5:
            assert not ended
            time.sleep(0.01)
            acknowledged = launcher.bus.request(topics.STATUS["backend"], Empty()).counters.get("keyframes", 0)
        if stall:
            os.kill(launcher.process_id("vocab"), signal.SIGSTOP)
            stored = 0
            while stored < acknowledged + 3:  # they get no candidates any more
                assert not ended
                time.sleep(0.01)
                stored = launcher.bus.request(topics.STATUS["backend"], Empty()).counters["keyframes"]
        began = time.monotonic()
        launcher.stop()
        took_s = time.monotonic() - began
        sender.join(20)
    assert took_s < STOP_TIMEOUT_S + SLACK_S
    assert check_map(path).problems == ()
    with MapStore(path) as store:
        ids, mapped = store.keyframe_ids(), int(store.meta().get("mapped", -1))
        assert ids == list(range(len(ids))) and len(ids) >= acknowledged
    assert [one.name for one in tmp_path.glob("map.seamark*")] == ["map.seamark"]
    if not stall:
        return
    # What was stored and not mapped is mapped after the next start, with candidates that are asked for again.
    assert ids[-1] > mapped
    with Launcher(settings) as launcher:
        for frame in frames[:20]:
            launcher.bus.request(topics.FRAME, replace(frame, stamp_ns=frame.stamp_ns + 10**12), 60.0)
        for node in topics.NODES:
            launcher.bus.request(topics.DRAIN[node], Empty(), 60.0)
        counters = launcher.bus.request(topics.STATUS["backend"], Empty()).counters
    assert counters["candidates_asked_again"] == ids[-1] - mapped and "candidates_missing" not in counters
    with MapStore(path) as store:
        assert int(store.meta()["mapped"]) == store.keyframe_ids()[-1] > ids[-1]
