"""The three real nodes as processes: a toy world is mapped, also when nodes are killed in the middle of it."""

import os
import signal
import time
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.backend.map_store import MapStore
from seamark.backend.types import MapSnapshot
from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.features import extract_features
from seamark.frontend.types import Frame, Mode, Odometry, Outcome
from seamark.service import topics
from seamark.service.config import load_config
from seamark.service.launcher import Launcher
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, PlaceError, PlaceQuery, PlaceReply
from seamark.vocab.training import train

pytestmark = pytest.mark.zenoh
WINDOW = 4
PATIENCE_S = 60.0
SEED = 5
Outcomes = tuple[list[Odometry], MapSnapshot, dict[str, int], PlaceReply]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(toy_sequence("loop", 90, SEED, Mode.RGBD).frames())


@pytest.fixture(scope="module")
def vocabulary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vocabulary") / "words"
    other = toy_sequence("turn", 10, SEED + 1).frames()
    train((extract_features(frame.image, 300).descriptors for frame in other), 256, 0).save(path)
    return path


def settings(folder: Path, vocabulary: Path) -> NodeSettings:
    return NodeSettings(
        Mode.RGBD,
        ToyWorld(SEED).rig(Mode.RGBD),
        load_config(overrides=["frontend.keyframe_parallax_px=8", "vocab.exclude_recent_s=2"]),
        vocabulary=vocabulary,
        map_path=folder / "map.seamark",
        log_level="ERROR",
    )


def send_all(launcher: Launcher, frames: list[Frame], kill_at: dict[int, str]) -> list[Odometry]:
    pending, odometry = deque[object](), []
    for frame in frames:
        if (node := kill_at.get(frame.index)) is not None:
            os.kill(launcher.process_id(node), signal.SIGKILL)
        pending.append(launcher.bus.request_async(topics.FRAME, frame, PATIENCE_S))
        if len(pending) == WINDOW:
            odometry.append(pending.popleft().result())  # type: ignore[attr-defined]
    odometry += [future.result() for future in pending]  # type: ignore[attr-defined]
    launcher.wait_until_alive()
    for node in topics.NODES:
        launcher.bus.request(topics.DRAIN[node], Empty(), PATIENCE_S)
    return odometry


def run(folder: Path, vocabulary: Path, frames: list[Frame], kill_at: dict[int, str]) -> Outcomes:
    with Launcher(settings(folder, vocabulary)) as launcher:
        odometry = send_all(launcher, frames, kill_at)
        snapshot = launcher.bus.request(topics.MAP_SNAPSHOT, Empty())
        encoded = bytes(cv2.imencode(".png", frames[len(frames) // 2].image)[1])
        reply = launcher.bus.request(topics.PLACE, PlaceQuery(encoded), PATIENCE_S)
        restarts = launcher.restarts
    return odometry, snapshot, restarts, reply


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory, vocabulary: Path, frames: list[Frame]) -> Outcomes:
    return run(tmp_path_factory.mktemp("calm"), vocabulary, frames, {})


def test_a_loop_is_mapped_and_a_place_recognised(calm: Outcomes, frames: list[Frame]) -> None:
    odometry, snapshot, restarts, reply = calm
    assert [one.index for one in odometry] == list(range(len(frames)))
    assert all(one.outcome in (Outcome.TRACKED, Outcome.NEW_SESSION, Outcome.RECOVERED) for one in odometry)
    sent = [one.keyframe_id for one in odometry if one.keyframe_id is not None]
    assert list(snapshot.keyframe_ids) == sent == list(range(len(sent))) and len(sent) >= 10
    assert restarts == dict.fromkeys(topics.NODES, 0)
    assert reply.error_code is None and reply.places[0].accepted
    assert abs(reply.places[0].stamp_ns - frames[len(frames) // 2].stamp_ns) < 1_000_000_000


def test_killed_readers_change_nothing(tmp_path: Path, vocabulary: Path, frames: list[Frame], calm: Outcomes) -> None:
    calm_odometry, calm_map, _, _ = calm
    odometry, snapshot, restarts, reply = run(tmp_path, vocabulary, frames, {30: "backend", 50: "vocab"})
    assert restarts == {"frontend": 0, "vocab": 1, "backend": 1}
    for one, other in zip(odometry, calm_odometry, strict=True):
        np.testing.assert_array_equal(one.T_odom_cam, other.T_odom_cam)
    np.testing.assert_array_equal(snapshot.keyframe_ids, calm_map.keyframe_ids)
    np.testing.assert_allclose(snapshot.T_map_cam, calm_map.T_map_cam, atol=0.05)
    assert reply.error_code is None
    with MapStore(tmp_path / "map.seamark", read_only=True) as store:
        assert [one.id for one in store.load_keyframes()] == list(calm_map.keyframe_ids)
        assert store.meta()["mapped"] == str(calm_map.keyframe_ids[-1])


def test_a_map_goes_on_in_another_session(tmp_path: Path, vocabulary: Path, frames: list[Frame]) -> None:
    _, first, _, _ = run(tmp_path, vocabulary, frames[:40], {})
    odometry, second, _, _ = run(tmp_path, vocabulary, frames[40:], {})
    assert odometry[0].keyframe_id == len(first.keyframe_ids) and odometry[0].session == 1
    assert len(second.keyframe_ids) > len(first.keyframe_ids)
    assert set(second.sessions) == {0, 1}


def test_an_empty_map_answers_and_knows_nothing(tmp_path: Path, vocabulary: Path, frames: list[Frame]) -> None:
    started = time.monotonic()
    with Launcher(settings(tmp_path, vocabulary)) as launcher:
        encoded = bytes(cv2.imencode(".jpg", frames[0].image)[1])
        reply = launcher.bus.request(topics.PLACE, PlaceQuery(encoded), PATIENCE_S)
        assert reply.error_code is PlaceError.EMPTY_MAP
    assert time.monotonic() - started < PATIENCE_S
