"""The place index beside the map: it saves describing keyframes, and the map is believed wherever the two differ."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.config import DriftConfig
from seamark.backend.contraction import contract
from seamark.backend.graph_types import Node
from seamark.backend.map_contraction import contracted
from seamark.backend.map_store import MapStore
from seamark.frontend.types import Features, Keyframe, Mode
from seamark.service import topics
from seamark.service.bus import LocalBus
from seamark.service.config import load_config
from seamark.service.nodes import places_cache, vocab_node
from seamark.service.nodes.places_cache import cache_path, observe
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty, Forget
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.vocabulary import Vocabulary

COUNT = 40


def forget(store: MapStore, keyframe_ids: list[int]) -> None:
    nodes = [Node(one.id, one.session, one.previous_id, np.eye(4), np.zeros((6, 6))) for one in store.load_nodes()]
    graph = contract(nodes, [], keyframe_ids, DriftConfig())
    store.contract(contracted(graph, {}, {node.session: node.session for node in nodes}))


@pytest.fixture(scope="module")
def vocabulary_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("words") / "small.vocab"
    Vocabulary(rng.integers(0, 256, (64, 128)).astype(np.uint8), np.ones(64, np.float32)).save(path)
    return path


@pytest.fixture(autouse=True)
def every_change_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places_cache, "LEAST_CHANGES", 1)
    monkeypatch.setattr(places_cache, "SHARE_OF_PLACES", 10.0)  # while it runs not at all, in these small maps


def keyframe(number: int, world: int = 0) -> Keyframe:
    rng = np.random.default_rng((world, number))
    seen = Features(
        rng.random((30, 2)).astype(np.float32),
        np.ones(30, np.float32),
        np.ones(30, np.float32),
        rng.integers(0, 256, (30, 128)).astype(np.uint8),
    )
    thumbnail = rng.integers(0, 256, (24, 32, 3)).astype(np.uint8)
    # In images of a folder the stamp is a running index: it is the same in every map.
    return Keyframe(number, 0, number, 10**9 * number, "", seen, np.zeros((30, 3), np.float32), thumbnail, b"")


def fill(folder: Path, numbers: range, world: int = 0) -> Path:
    path = folder / "map.seamark"
    with MapStore(path) as store:
        for number in numbers:
            store.add_keyframe(keyframe(number, world))
    return path


class Run:
    """The node of a service on a map, and what it says of itself."""

    def __init__(self, path: Path, vocabulary: Path, localise_only: bool = False, *overrides: str) -> None:
        config = load_config(None, {}, list(overrides))
        settings = NodeSettings(
            Mode.RGBD,
            config=config,
            vocabulary=vocabulary,
            map_path=path,
            restore=path.exists(),
            patient=True,
            localise_only=localise_only,
        )
        self.bus = LocalBus()
        self.bus.for_node("backend").handle(topics.KEYFRAME, lambda _: None)
        self.bus.for_node("backend").handle(topics.CANDIDATES, lambda _: None)
        self.node = vocab_node.build(self.bus.for_node("vocab"), settings)

    def counters(self) -> dict[str, int]:
        counters: dict[str, int] = self.bus.request(topics.STATUS["vocab"], Empty()).counters
        return counters

    def ranked(self, number: int) -> list[tuple[int, float]]:
        asked = replace(observe(keyframe(number)), id=-1, session=-1)
        return [(found.id, found.score) for found in self.bus.request(topics.PLACES_RANK, asked).ranked]

    def end(self) -> dict[str, int]:
        self.node.stop()
        self.node.close()
        return self.counters()


def anew(path: Path, vocabulary: Path) -> PlaceIndex:
    index = PlaceIndex(Vocabulary.load(vocabulary))
    with MapStore(path, read_only=True) as store:
        for number in store.keyframe_ids(recognisable=True):
            index.add(observe(store.keyframe(number)))
    return index


def same_answers(run: Run, index: PlaceIndex) -> None:
    for number in (0, 7, COUNT - 1):
        asked = replace(observe(keyframe(number)), id=-1, session=-1)
        wanted = [(found.id, found.score) for found in index.query(asked).ranked]
        ids, scores = zip(*run.ranked(number), strict=True)
        assert ids == tuple(place for place, _ in wanted)
        np.testing.assert_allclose(scores, [score for _, score in wanted], atol=1e-6)  # sums of other slots round so


def test_a_restart_describes_nothing_again_and_answers_the_same(tmp_path: Path, vocabulary_file: Path) -> None:
    path = fill(tmp_path, range(COUNT))
    first = Run(path, vocabulary_file)
    assert first.end()["places_described_at_start"] == COUNT and cache_path(path).exists()
    again = Run(path, vocabulary_file)
    counters = again.counters()
    assert (counters["places_described_at_start"], counters["places"], counters["next_keyframe_id"]) == (0, 40, 40)
    same_answers(again, anew(path, vocabulary_file))
    assert "places_written" not in again.end()  # nothing had changed


def test_what_the_map_got_and_lost_since_is_followed(tmp_path: Path, vocabulary_file: Path) -> None:
    """Test: after the file was written a crash, 5 keyframes more, 3 forgotten, 1 whose number was given anew."""
    path = fill(tmp_path, range(COUNT))
    Run(path, vocabulary_file).end()
    with MapStore(path) as store:
        forget(store, [3, 4, 5])
        for number in range(COUNT, COUNT + 5):
            store.add_keyframe(keyframe(number))
        store.add_keyframe(replace(keyframe(COUNT - 1), stamp_ns=10**9 * COUNT - 1))
    run = Run(path, vocabulary_file)
    assert run.counters()["places_described_at_start"] == 6
    assert run.counters()["places"] == COUNT + 2
    same_answers(run, anew(path, vocabulary_file))
    assert run.end()["places_written"] == 1
    assert Run(path, vocabulary_file).counters()["places_described_at_start"] == 0


def test_what_comes_and_goes_in_a_run_is_kept(tmp_path: Path, vocabulary_file: Path) -> None:
    run = Run(tmp_path / "map.seamark", vocabulary_file)
    for number in range(COUNT):
        run.bus.send(topics.KEYFRAME, keyframe(number))
        run.bus.drain()
    run.bus.send(topics.FORGET, Forget(np.array([7], np.int64)))
    run.bus.drain()
    run.end()
    path = fill(tmp_path, range(COUNT))
    with MapStore(path) as store:
        forget(store, [7])
    again = Run(path, vocabulary_file)
    assert again.counters()["places_described_at_start"] == 0
    same_answers(again, anew(path, vocabulary_file))


def test_it_is_written_while_the_service_runs(
    tmp_path: Path, vocabulary_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places_cache, "LEAST_CHANGES", 10)
    monkeypatch.setattr(places_cache, "SHARE_OF_PLACES", 0.1)
    run = Run(tmp_path / "map.seamark", vocabulary_file)
    for number in range(12):
        run.bus.send(topics.KEYFRAME, keyframe(number))
        run.bus.drain()
    assert run.node._cache is not None and run.node._cache._writing is not None
    run.node._cache._writing.join()
    assert run.counters()["places_written"] == 1  # and it is killed now
    path = fill(tmp_path, range(12))
    left_over = tmp_path / ".map.seamark.places.abcd"
    left_over.write_bytes(b"half")
    assert Run(path, vocabulary_file).counters()["places_described_at_start"] == 2
    assert not left_over.exists()


def test_a_small_map_gets_no_file(tmp_path: Path, vocabulary_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places_cache, "LEAST_CHANGES", COUNT + 1)
    Run(fill(tmp_path, range(COUNT)), vocabulary_file).end()
    assert not [file.name for file in tmp_path.iterdir() if file.name.endswith(".places")]


def flipped(at: float) -> Callable[[Path], object]:
    def damage(file: Path) -> None:
        data = bytearray(file.read_bytes())
        data[int(at * len(data))] ^= 0x10
        file.write_bytes(data)

    return damage


DAMAGES: dict[str, Callable[[Path], object]] = {
    "header": flipped(0.0005),
    "middle": flipped(0.5),
    "end": flipped(0.97),
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:5000]),
    "empty": lambda file: file.write_bytes(b""),
    "other": lambda file: file.write_bytes(b"SQLite format 3\0" * 100),
    "folder": lambda file: (file.unlink(), file.mkdir()),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_file_is_made_again_from_the_map(name: str, tmp_path: Path, vocabulary_file: Path) -> None:
    path = fill(tmp_path, range(COUNT))
    Run(path, vocabulary_file).end()
    DAMAGES[name](cache_path(path))
    run = Run(path, vocabulary_file)
    assert run.counters()["places_described_at_start"] == COUNT
    same_answers(run, anew(path, vocabulary_file))
    counters = run.end()
    assert counters.get("places_unwritable", 0) == (name == "folder")  # as if the disk took nothing: no harm done
    assert counters.get("places_written", 0) == (name != "folder")


def test_the_file_of_another_map_is_not_believed(tmp_path: Path, vocabulary_file: Path) -> None:
    """Test: two maps of as many images with the same numbers and stamps; the file of one lies beside the other."""
    (tmp_path / "other").mkdir()
    other = fill(tmp_path / "other", range(COUNT), world=1)
    Run(other, vocabulary_file).end()
    path = fill(tmp_path, range(COUNT))
    shutil.copy(cache_path(other), cache_path(path))
    run = Run(path, vocabulary_file)
    assert run.counters()["places_described_at_start"] == COUNT
    same_answers(run, anew(path, vocabulary_file))


@pytest.mark.parametrize("override", ["vocab.max_descriptors=10", "vocab.signatures=true", "vocab.histogram_bins=16"])
def test_other_settings_make_another_index(override: str, tmp_path: Path, vocabulary_file: Path) -> None:
    path = fill(tmp_path, range(COUNT))
    Run(path, vocabulary_file).end()
    changed = Run(path, vocabulary_file, False, override)
    assert changed.counters()["places_described_at_start"] == COUNT
    changed.end()
    assert Run(path, vocabulary_file, False, override).counters()["places_described_at_start"] == 0


def test_a_service_that_only_localises_reads_the_file_and_writes_none(tmp_path: Path, vocabulary_file: Path) -> None:
    path = fill(tmp_path, range(COUNT))
    Run(path, vocabulary_file, True).end()
    assert [file.name for file in tmp_path.iterdir()] == ["map.seamark"]
    Run(path, vocabulary_file).end()
    before = cache_path(path).stat()
    assert Run(path, vocabulary_file, True).counters()["places_described_at_start"] == 0
    assert cache_path(path).stat() == before
