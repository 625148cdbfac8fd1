"""The three nodes on a LocalBus: what they send, in which order, and what they do with what goes wrong."""

import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.backend.config import DriftConfig, MapConfig
from seamark.backend.contraction import contract
from seamark.backend.graph_types import Node
from seamark.backend.map_contraction import Contracted, contracted
from seamark.backend.map_store import MapStore
from seamark.backend.slam import StepResult
from seamark.backend.types import Loop, MapSnapshot, Place, Reason
from seamark.datasets_synth.toy import toy_sequence
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features
from seamark.frontend.odometry import Frontend, FrontendResult
from seamark.frontend.types import Camera, Features, Filled, Frame, Keyframe, Mode, Odometry, Outcome, Quality
from seamark.service import topics
from seamark.service.bus import LocalBus, RemoteError
from seamark.service.nodes import backend_node
from seamark.service.nodes.backend_node import BackendNode
from seamark.service.nodes.frontend_node import FrontendNode
from seamark.service.nodes.places_cache import observe
from seamark.service.nodes.vocab_node import VocabNode
from seamark.service.requests import Done, Empty, EncodedFrame, PlaceError, PlaceQuery
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.training import train
from seamark.vocab.types import Candidate, Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

GREY = np.zeros((4, 6), np.uint8)


def keyframe(number: int, session: int = 0) -> Keyframe:
    return Keyframe(
        number, session, number, 100 * number, "", Features.empty(), np.zeros((0, 3), np.float32), GREY, b""
    )


def candidates(number: int, *places: int) -> Candidates:
    return Candidates(number, 100 * number, tuple(Candidate(place, 0.5, 0.5, 0.1) for place in places))


class FakeSlam:
    """Accepts the first candidate of every keyframe; fails at keyframe 13."""

    feature_bytes = 0
    localised = True

    def __init__(self) -> None:
        self.steps: list[tuple[int, tuple[int, ...]]] = []
        self.finished = 0
        self.nodes: tuple[Node, ...] = ()
        self.gone: set[int] = set()

    def step(self, keyframe: Keyframe, candidates: Candidates) -> StepResult:
        if keyframe.id == 13:
            raise SeamarkError("thirteen")
        assert keyframe.id == candidates.query_id
        if keyframe.T_odom_cam is not None:
            node = Node(keyframe.id, keyframe.session, keyframe.previous_id, keyframe.T_odom_cam, np.zeros((6, 6)))
            self.nodes = (*self.nodes, node)
        self.steps.append((keyframe.id, tuple(candidate.id for candidate in candidates.ranked)))
        loops = tuple(
            Loop(keyframe.id, one.id, True, Reason.ACCEPTED, 40, 0.5, 0.5, 0.1) for one in candidates.ranked[:1]
        )
        return StepResult(loops, 0, bool(loops), {"verify": 2.0})

    def finish(self) -> StepResult:
        self.finished += 1
        return StepResult((), 0, True)

    def restore(self, keyframes: list[Keyframe], loops: list[Loop], *_: object, held: bool = False) -> None:
        self.restored = [one.id for one in keyframes], [(loop.query_id, loop.match_id) for loop in loops]

    def snapshot(self) -> MapSnapshot:
        ids = np.array([number for number, _ in self.steps if number not in self.gone], np.int64)
        poses = np.tile(np.eye(4), (len(ids), 1, 1))
        return MapSnapshot(len(ids), ids, ids * 0, ids * 0, poses, np.ones(len(ids)), ())

    def without(self, keyframe_ids: Collection[int]) -> Contracted:
        graph = contract(self.nodes, [], keyframe_ids, DriftConfig())
        return contracted(graph, {}, {node.session: node.session for node in self.nodes})

    def adopt(self, change: Contracted) -> None:
        self.nodes = change.graph.nodes
        self.gone |= change.graph.gone

    def locate(self, keyframe: Keyframe, candidates: Candidates) -> tuple[Place, ...]:
        self.camera = keyframe.camera
        return tuple(
            Place(one.id, 0, 0, "", one.score, one.votes, one.jeffrey, 0, False, Reason.FEW_INLIERS)
            for one in candidates.ranked
        )


class FullDisk(MapStore):
    """A map that cannot take keyframe 77."""

    def add_keyframe(self, keyframe: Keyframe) -> None:
        if keyframe.id == 77:
            raise SeamarkError("the disk is full")
        super().add_keyframe(keyframe)


class Backend:
    """A BackendNode between fakes, and who sends to it."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.bus = LocalBus()
        self.slam, self.store = FakeSlam(), FullDisk(folder / "map.seamark")
        self.node = BackendNode(self.bus.for_node("backend"), self.slam, self.store, FrontendConfig(), **settings)
        self.bus.for_node("vocab").handle(topics.KEYFRAME, lambda _: None)

    def send(self, *messages: Keyframe | Candidates) -> None:
        for message in messages:
            self.bus.send(topics.KEYFRAME if isinstance(message, Keyframe) else topics.CANDIDATES, message)
            self.bus.drain()

    def counters(self) -> dict[str, int]:
        counters: dict[str, int] = self.bus.request(topics.STATUS["backend"], Empty()).counters
        return counters


@pytest.mark.parametrize(
    "order",
    [
        [keyframe(0), candidates(0), keyframe(1), candidates(1, 0), keyframe(2), candidates(2, 0, 1)],
        [keyframe(0), keyframe(1), keyframe(2), candidates(0), candidates(1, 0), candidates(2, 0, 1)],
        [candidates(0), candidates(1, 0), candidates(2, 0, 1), keyframe(0), keyframe(1), keyframe(2)],
        [candidates(0), keyframe(0), keyframe(1), candidates(1, 0), candidates(2, 0, 1), keyframe(2)],
    ],
)
def test_keyframes_meet_their_candidates_in_any_order_of_arrival(
    order: list[Keyframe | Candidates], tmp_path: Path
) -> None:
    backend = Backend(tmp_path)
    loops: list[Loop] = []
    maps: list[MapSnapshot] = []
    backend.bus.subscribe(topics.LOOP, loops.append)
    backend.bus.subscribe(topics.MAP, maps.append)
    backend.send(*order)
    assert backend.slam.steps == [(0, ()), (1, (0,)), (2, (0, 1))]
    assert [(loop.query_id, loop.match_id) for loop in loops] == [(1, 0), (2, 0)]
    assert [len(one.keyframe_ids) for one in maps] == [2, 3]
    assert [one.id for one in backend.store.load_keyframes()] == [0, 1, 2]
    assert [(loop.query_id, loop.match_id) for loop in backend.store.load_loops()] == [(1, 0), (2, 0)]
    counters = backend.counters()
    assert counters["keyframes"] == 3 and counters["verdicts_accepted"] == 2 and counters["next_keyframe_id"] == 3


def test_repeats_are_acknowledged_and_forgotten(tmp_path: Path) -> None:
    backend = Backend(tmp_path)
    backend.send(keyframe(0), keyframe(0), candidates(0), candidates(0), keyframe(0), candidates(0))
    assert backend.slam.steps == [(0, ())]
    counters = backend.counters()
    assert counters["keyframes_again"] == 2 and counters["candidates_again"] == 2


def test_a_restarted_back_end_takes_in_its_map_and_waits_for_what_was_not_mapped(tmp_path: Path) -> None:
    first = Backend(tmp_path)
    first.send(keyframe(0), candidates(0), keyframe(1, 1), candidates(1, 0), keyframe(2, 1))
    first.store.close()  # killed: number 2 is on disk, its candidates were not acknowledged
    second = Backend(tmp_path)
    assert second.slam.restored == ([0, 1], [(1, 0)])
    counters = second.counters()
    expected = {"keyframes_restored": 2, "next_keyframe_id": 3, "next_session": 2, "learning": 1}
    assert counters == expected | {"feature_bytes": 0, "localised": 1}
    second.send(candidates(1, 0), candidates(2, 1), keyframe(2, 1), keyframe(3), candidates(3))
    assert second.slam.steps == [(2, (1,)), (3, ())]
    assert second.counters()["candidates_again"] == second.counters()["keyframes_again"] == 1
    second.bus.request(topics.DRAIN["backend"], Empty())
    second.node.close()
    third = Backend(tmp_path)
    assert third.slam.restored == ([0, 1, 2, 3], [(1, 0), (2, 1)])
    third.node.stop()
    assert third.slam.finished == 0  # nothing new


def test_a_stopping_back_end_stores_at_once_and_maps_in_its_next_life(tmp_path: Path) -> None:
    """Test: keyframes and candidates come while the service stops. Expected: all acknowledged and on disk; mapped is
    what has its candidates, in the end or after the next start, whose vocabulary is asked for them again.
    """
    first = Backend(tmp_path)
    first.send(keyframe(0), candidates(0))
    first.bus.request(topics.STOPPING, Empty())
    first.send(keyframe(1), candidates(1, 0), keyframe(2))
    assert first.slam.steps == [(0, ())] and [one.id for one in first.store.load_keyframes()] == [0, 1, 2]
    first.node.stop()
    assert first.slam.steps == [(0, ()), (1, (0,))]
    first.node.close()
    second = Backend(tmp_path)
    asked: list[int] = []

    def rank(observation: PlaceObservation) -> Candidates:
        asked.append(observation.id)
        return candidates(observation.id, 0, 1)

    second.bus.for_node("vocab").handle(topics.PLACES_RANK, rank)
    second.send(keyframe(3), candidates(3))
    assert second.slam.steps == [(2, (0, 1)), (3, ())] and asked == [2]
    assert second.counters()["candidates_asked_again"] == 1


def test_the_order_to_store_alone_does_not_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend_node, "STORING_S", 0.05)
    backend = Backend(tmp_path)
    backend.bus.request(topics.STOPPING, Empty())
    backend.send(keyframe(0), candidates(0))
    assert backend.slam.steps == []
    time.sleep(0.06)
    backend.send(keyframe(1), candidates(1, 0))
    assert backend.slam.steps == [(0, ()), (1, (0,))]


def test_a_keyframe_that_the_vocabulary_refused_is_mapped_without_candidates(tmp_path: Path) -> None:
    backend = Backend(tmp_path)
    backend.send(keyframe(0), candidates(0), keyframe(1), keyframe(2), candidates(2, 0))
    assert backend.slam.steps == [(0, ()), (1, ()), (2, (0,))]
    assert backend.counters()["candidates_missing"] == 1


def test_without_loops_candidates_are_ignored(tmp_path: Path) -> None:
    backend = Backend(tmp_path, no_loops=True)
    backend.send(keyframe(0), keyframe(1), candidates(0), candidates(1, 0), candidates(2, 0), keyframe(2))
    assert backend.slam.steps == [(0, ()), (1, ()), (2, ())]


def test_a_failure_is_told_and_the_next_keyframes_are_mapped(tmp_path: Path) -> None:
    backend = Backend(tmp_path)
    with pytest.raises(RemoteError, match="thirteen"):
        backend.send(keyframe(13), candidates(13))
    with pytest.raises(RemoteError, match="the disk is full"):
        backend.send(keyframe(77))
    backend.bus.drain()
    backend.send(keyframe(78), candidates(78))
    assert backend.slam.steps == [(78, ())]


def test_draining_maps_what_waits_and_writes_the_poses(tmp_path: Path) -> None:
    backend = Backend(tmp_path)
    backend.send(keyframe(0), keyframe(1))
    assert backend.slam.steps == []
    assert backend.bus.request(topics.DRAIN["backend"], Empty()) == Done("backend")
    assert backend.slam.steps == [(0, ()), (1, ())] and backend.slam.finished == 1
    assert sorted(backend.store.load_poses()) == [0, 1]
    assert backend.bus.request(topics.DRAIN["backend"], Empty()) == Done("backend")
    assert backend.slam.finished == 1
    assert len(backend.bus.request(topics.MAP_SNAPSHOT, Empty()).keyframe_ids) == 2
    backend.node.close()
    assert not backend.store.path.with_name("map.seamark-wal").exists()


class FakeFrontend:
    """Every frame is tracked and two in three become keyframes, one step late."""

    def __init__(self) -> None:
        self._late: list[Keyframe] = []
        self._next = 0
        self.closed = False

    def step(self, frame: Frame) -> FrontendResult:
        ready, self._late = tuple(self._late), []
        number = None
        if frame.index % 3:
            number, self._next = self._next, self._next + 1
            self._late = [replace(keyframe(number), previous_id=number - 1 if number else None)]
        filled = (Filled(0, 0, 0, 0, np.eye(4)),)
        odometry = Odometry(
            frame.index,
            frame.stamp_ns,
            frame.file,
            0 if frame.index else -1,
            Quality.GOOD,
            Outcome.TRACKED,
            reference_id=number,
            keyframe_id=number,
            filled=filled,
            stages_ms={"track": 1.0},
        )
        return FrontendResult(odometry, ready)

    def finish(self) -> tuple[Keyframe, ...]:
        ready, self._late = tuple(self._late), []
        return ready

    def close(self) -> None:
        self.closed = True


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])


def run_frontend(frames: Sequence[Frame | EncodedFrame], **settings: int) -> tuple[list[Odometry], list[Keyframe], Any]:
    bus, keyframes = LocalBus(), []
    fake = FakeFrontend()
    node = FrontendNode(bus.for_node("frontend"), fake, **settings)  # type: ignore[arg-type]
    for reader in ("vocab", "backend"):
        bus.for_node(reader).handle(topics.KEYFRAME, keyframes.append if reader == "vocab" else lambda _: None)
    published: list[Odometry] = []
    bus.subscribe(topics.ODOMETRY, published.append)
    odometry = [bus.request(topics.FRAME, frame) for frame in frames]
    assert bus.request(topics.DRAIN["frontend"], Empty()) == Done("frontend")
    assert [one.index for one in published] == [one.index for one in odometry]
    status = bus.request(topics.STATUS["frontend"], Empty())
    node.close()
    assert fake.closed
    return odometry, keyframes, status


def test_frames_are_answered_and_late_keyframes_sent() -> None:
    odometry, keyframes, status = run_frontend([Frame(index, index, GREY) for index in range(6)])
    assert [one.keyframe_id for one in odometry] == [None, 0, 1, None, 2, 3]
    assert [one.id for one in keyframes] == [0, 1, 2, 3]
    assert status.counters == {"frames": 6, "frames_tracked": 6, "keyframes": 4}
    assert status.stages_ms["track"] == [1.0] * 6 and len(status.stages_ms["frame"]) == 6
    assert status.node == "frontend" and 20e6 < status.rss_bytes <= status.peak_rss_bytes < 20e9 and status.cpu_s > 0


def test_frames_of_a_live_camera_are_taken_too() -> None:
    bus, published = LocalBus(), []
    FrontendNode(bus.for_node("frontend"), FakeFrontend())  # type: ignore[arg-type]
    bus.subscribe(topics.ODOMETRY, lambda odometry: published.append(odometry.index))
    for index in range(2):
        bus.publish(topics.CAMERA, Frame(3 * index, index, GREY))
    bus.pump()
    assert published == [0, 3]


def test_a_restarted_front_end_goes_on_counting() -> None:
    odometry, keyframes, _ = run_frontend(
        [Frame(index, index, GREY) for index in range(3)], first_keyframe_id=40, first_session=2
    )
    assert [one.keyframe_id for one in odometry] == [None, 40, 41]
    assert [one.reference_id for one in odometry] == [None, 40, 41]
    assert [one.session for one in odometry] == [-1, 2, 2]
    assert odometry[1].filled[0].reference_id == 40 and odometry[1].filled[0].session == 2
    assert [(one.id, one.previous_id, one.session) for one in keyframes] == [(40, None, 2), (41, 40, 2)]


def test_encoded_frames_are_decoded_and_broken_ones_reported() -> None:
    colour = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    depth = np.arange(24, dtype=np.uint16).reshape(4, 6)
    seen: list[Frame] = []
    bus = LocalBus()
    fake = FakeFrontend()
    step = fake.step
    fake.step = lambda frame: (seen.append(frame), step(frame))[1]  # type: ignore[method-assign, func-returns-value]
    FrontendNode(bus.for_node("frontend"), fake)  # type: ignore[arg-type]
    whole = EncodedFrame(0, 5, png(colour), png(GREY), png(depth), "a.png")
    assert bus.request(topics.FRAME, whole).outcome is Outcome.TRACKED
    np.testing.assert_array_equal(seen[0].image, colour)
    np.testing.assert_array_equal(seen[0].image_right, GREY)
    np.testing.assert_array_equal(seen[0].depth, depth)
    for broken in (
        EncodedFrame(1, 6, b"", file="b.png"),
        EncodedFrame(1, 6, png(colour)[:-20]),
        EncodedFrame(1, 6, png(GREY), None, png(colour)),
        EncodedFrame(1, 6, png(GREY), b"no image"),
    ):
        odometry = bus.request(topics.FRAME, broken)
        assert (odometry.index, odometry.stamp_ns, odometry.file) == (1, 6, broken.file)
        assert odometry.outcome is Outcome.UNREADABLE and odometry.quality is Quality.LOST and odometry.session == -1
    assert len(seen) == 1


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(toy_sequence("line", 24, seed=3).frames())


@pytest.fixture(scope="module")
def vocabulary(frames: list[Frame]) -> Vocabulary:
    other = toy_sequence("turn", 6, seed=9).frames()
    return train((extract_features(frame.image, 200).descriptors for frame in other), 64, 0)


def run_all(frames: list[Frame], vocabulary: Vocabulary) -> tuple[LocalBus, FakeSlam, list[Odometry]]:
    bus, slam = LocalBus(), FakeSlam()
    config = FrontendConfig(keyframe_max_gap_s=0.2)
    rig = toy_sequence("line", 24, seed=3).rig
    frontend = FrontendNode(bus.for_node("frontend"), Frontend(rig, Mode.RGBD, config))
    VocabNode(bus.for_node("vocab"), PlaceIndex(vocabulary))
    BackendNode(bus.for_node("backend"), slam, None, config, rig.cam0 if rig else None)
    odometry = []
    for frame in frames:
        odometry.append(bus.request(topics.FRAME, frame))
        bus.pump()
    for node in topics.NODES:
        bus.request(topics.DRAIN[node], Empty())
    frontend.close()
    return bus, slam, odometry


def test_three_nodes_map_a_toy_world_the_same_twice(frames: list[Frame], vocabulary: Vocabulary) -> None:
    _, slam, odometry = run_all(frames, vocabulary)
    _, again, odometry_again = run_all(frames, vocabulary)
    ids = [number for number, _ in slam.steps]
    assert ids == list(range(len(ids))) and 3 <= len(ids) < len(frames)
    assert slam.steps == again.steps
    for one, other in zip(odometry, odometry_again, strict=True):
        assert one.outcome in (Outcome.TRACKED, Outcome.NEW_SESSION)
        np.testing.assert_array_equal(one.T_odom_cam, other.T_odom_cam)


def test_place_queries_are_ranked_and_located(frames: list[Frame], vocabulary: Vocabulary) -> None:
    bus, slam, _ = run_all(frames, vocabulary)
    reply = bus.request(topics.PLACE, PlaceQuery(png(frames[-1].image), top_k=2))
    assert reply.error_code is None and len(reply.places) == 2
    assert reply.places[0].keyframe_id >= slam.steps[-1][0] - 1  # the last keyframes look most like the last frame
    assert set(reply.timings_ms) == {"decode", "features", "rank", "locate"}
    assert slam.camera == toy_sequence("line", 24, seed=3).rig.cam0  # type: ignore[union-attr]
    counters = bus.request(topics.STATUS["vocab"], Empty()).counters
    assert counters["places"] == len(slam.steps)


@pytest.mark.parametrize(
    "query, code",
    [
        (PlaceQuery(b"no image"), PlaceError.UNDECODABLE_IMAGE),
        (PlaceQuery(b""), PlaceError.UNDECODABLE_IMAGE),
        (PlaceQuery(png(np.full((60, 80), 128, np.uint8))), PlaceError.NO_FEATURES),
        (PlaceQuery(png(GREY), camera=Camera(60, 40, 50, 50, 30, 20)), PlaceError.BAD_REQUEST),
    ],
)
def test_bad_place_queries_have_typed_answers(query: PlaceQuery, code: PlaceError, vocabulary: Vocabulary) -> None:
    bus = LocalBus()
    VocabNode(bus.for_node("vocab"), PlaceIndex(vocabulary))
    BackendNode(bus.for_node("backend"), FakeSlam(), None, FrontendConfig())
    reply = bus.request(topics.PLACE, query)
    assert reply.error_code is code and reply.error_message and reply.places == ()
    assert reply.verdict == {PlaceError.UNDECODABLE_IMAGE: "unreadable", PlaceError.NO_FEATURES: "no_features"}.get(
        code
    )


def test_an_empty_map_is_told_from_an_unknown_place(frames: list[Frame], vocabulary: Vocabulary) -> None:
    bus = LocalBus()
    VocabNode(bus.for_node("vocab"), PlaceIndex(vocabulary))
    BackendNode(bus.for_node("backend"), FakeSlam(), None, FrontendConfig())
    assert bus.request(topics.PLACE, PlaceQuery(png(frames[0].image))).error_code is PlaceError.EMPTY_MAP


def test_a_keyframe_sent_again_is_ranked_and_not_added_again(vocabulary: Vocabulary) -> None:
    bus, ranked = LocalBus(), []
    bus.for_node("backend").handle(topics.KEYFRAME, lambda _: None)
    bus.for_node("backend").handle(topics.CANDIDATES, lambda c: ranked.append(c.query_id))
    index = PlaceIndex(vocabulary)
    index.add(observe(keyframe(0)))
    VocabNode(bus.for_node("vocab"), index)
    for number in (1, 1, 0):
        bus.send(topics.KEYFRAME, keyframe(number))
        bus.drain()
    assert ranked == [1, 1, 0]
    counters = bus.request(topics.STATUS["vocab"], Empty()).counters
    assert counters == {"places": 2, "keyframes": 1, "keyframes_again": 2, "next_keyframe_id": 2}


def test_a_budget_is_kept_and_the_vocabulary_forgets_too(vocabulary: Vocabulary, tmp_path: Path) -> None:
    """Test: 42 like views come in, room is for 10. Expected: the newest stay in file, index and memory: what is chosen
    after one keyframe goes after the next.
    """
    bus, slam = LocalBus(), FakeSlam()
    index = PlaceIndex(vocabulary)
    VocabNode(bus.for_node("vocab"), index)
    store = MapStore(tmp_path / "map.seamark")
    limits = MapConfig(keyframes=10)
    node = BackendNode(bus.for_node("backend"), slam, store, FrontendConfig(), limits=limits)
    rng = np.random.default_rng(0)
    T = np.eye(4)
    for number in range(20, 62):
        seen = Features(
            rng.random((20, 2)).astype(np.float32),
            np.ones(20, np.float32),
            np.ones(20, np.float32),
            rng.integers(0, 256, (20, 128)).astype(np.uint8),
        )
        landmarks = np.zeros((20, 3), np.float32)
        one = replace(keyframe(number), stamp_ns=10**10 * number, features=seen, landmarks=landmarks, T_odom_cam=T)
        bus.send(topics.KEYFRAME, one)
        bus.drain()
        ids = np.array(store.keyframe_ids())
        poses = np.tile(T, (len(ids), 1, 1))
        store.update_poses(MapSnapshot(1, ids, ids * 0, ids * 0, poses, np.ones(len(ids)), ()))
    bus.drain()
    kept = store.keyframe_ids(recognisable=True)
    assert 20 <= len(kept) <= 10 + 21 and store.keyframe_ids() == kept  # the newest twenty are spared
    assert {41, 61} <= set(kept)
    assert [number in index for number in range(20, 62)] == [number in kept for number in range(20, 62)]
    assert [node.id for node in slam.nodes] == kept
    counters = bus.request(topics.STATUS["backend"], Empty()).counters
    assert counters["views_forgotten"] == 42 - len(kept) and counters["views_over_budget"] == len(kept) - 1 - 9
    node.close()


def test_every_node_says_what_it_has_refused(vocabulary: Vocabulary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LocalBus, "refused", {"keyframe": 3, "frame": 1})
    bus = LocalBus()
    FrontendNode(bus.for_node("frontend"), FakeFrontend())  # type: ignore[arg-type]
    VocabNode(bus.for_node("vocab"), PlaceIndex(vocabulary))
    BackendNode(bus.for_node("backend"), FakeSlam(), None, FrontendConfig())
    for node in topics.NODES:
        counters = bus.request(topics.STATUS[node], Empty()).counters
        assert counters["keyframe_refused"] == 3 and counters["frame_refused"] == 1
