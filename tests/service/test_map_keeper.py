"""A disk that takes no more stops learning and nothing else; nothing acknowledged is lost, and learning goes on."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seamark.backend import map_store
from seamark.backend.errors import MapError, MapUnwritableError
from seamark.backend.map_file import MapFile
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend.types import Features, Keyframe
from seamark.service.bus import RemoteError
from seamark.service.nodes import map_keeper
from seamark.service.nodes.map_keeper import MapKeeper
from seamark.service.nodes.meter import Meter

PAGES = 60


def keyframe(number: int, size: int = 10_000) -> Keyframe:
    return Keyframe(
        number,
        0,
        number,
        number,
        str(number),
        Features.empty(),
        np.zeros((0, 3), np.float32),
        np.zeros((2, 2), np.uint8),
        bytes(size),
        T_odom_cam=np.eye(4),
    )


def loop(number: int) -> Loop:
    return Loop(number, 0, True, Reason.ACCEPTED, 50, 0.5, 0.5, 0.5, np.eye(4), np.eye(6))


def limit(store: MapStore, pages: int) -> None:
    """Bound the file as a full disk would: SQLite answers the same SQLITE_FULL."""
    store.file.database.execute(f"PRAGMA max_page_count = {pages}")


def until(condition: Callable[[], object], patience_s: float = 20.0) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(map_keeper, "RETRY_EVERY_S", 0.02)
    yield


@pytest.mark.usefixtures("quick")
def test_a_patient_keeper_waits_for_room_and_loses_nothing(tmp_path: Path) -> None:
    path, meter = tmp_path / "map.seamark", Meter("backend")
    keeper = MapKeeper(MapStore(path), meter, patient=True)
    limit(keeper.store, PAGES)
    taken = []
    with pytest.raises(RemoteError) as refused:
        for number in range(100):
            keeper.add_keyframe(keyframe(number))
            taken.append(number)
    assert refused.value.code == "BUSY" and 3 <= len(taken) < 20
    assert meter.status().counters["learning"] == 0
    # What was found out meanwhile waits, and so does its acknowledgement.
    limit(keeper.store, 1)
    done: Future[None] = Future()
    T = np.tile(np.eye(4), (len(taken), 1, 1))
    ids = np.array(taken)
    keeper.save([loop(number) for number in taken], MapSnapshot(3, ids, ids * 0, ids * 0, T, np.ones(len(ids)), ()), 2)
    keeper.save([loop(1)], None, taken[-1], done)
    if not done.done():  # free pages may have taken it
        time.sleep(0.2)
    assert [k.id for k in keeper.store.load_nodes()] == taken
    limit(keeper.store, 100_000)
    until(done.done)
    until(lambda: meter.status().counters["learning"] == 1)
    keeper.add_keyframe(keyframe(len(taken)))
    keeper.close()
    with MapStore(path) as store:
        assert store.keyframe_ids() == [*taken, len(taken)]
        assert [one.query_id for one in store.load_loops()] == taken
        assert store.meta()["mapped"] == str(taken[-1]) and store.meta()["revision"] == "3"
        assert sorted(store.load_poses()) == taken


def test_an_impatient_keeper_says_so(tmp_path: Path) -> None:
    meter = Meter("backend")
    keeper = MapKeeper(MapStore(tmp_path / "map.seamark"), meter)
    limit(keeper.store, PAGES)
    with pytest.raises(MapUnwritableError, match="full"):
        for number in range(100):
            keeper.add_keyframe(keyframe(number))
    assert meter.status().counters == {"learning": 0, "map_unwritable": 1}
    keeper.close()


@pytest.mark.usefixtures("quick")
def test_a_map_that_could_only_be_read_is_taken_over_when_it_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, meter = tmp_path / "map.seamark", Meter("backend")
    with MapStore(path) as store:
        store.set_meta({"mode": "rgbd"})
        store.add_keyframe(keyframe(0))
    writable = False

    def opened(path: Path, read_only: bool = False, beside_writer: bool = False, existing: bool = False) -> MapFile:
        if not writable and not read_only:
            raise MapUnwritableError("read-only file system")
        return MapFile(path, read_only, beside_writer, existing)

    monkeypatch.setattr(map_store, "MapFile", opened)
    keeper = MapKeeper(MapStore(path, read_only=True), meter, patient=True)
    assert meter.status().counters["learning"] == 0
    with pytest.raises(RemoteError, match="BUSY"):
        keeper.add_keyframe(keyframe(1))
    assert [k.id for k in keeper.store.load_nodes()] == [0]
    writable = True
    until(lambda: meter.status().counters["learning"] == 1)
    keeper.add_keyframe(keyframe(1))
    keeper.close()
    with MapStore(path) as store:
        assert store.keyframe_ids() == [0, 1]


def test_a_keyframe_without_its_predecessor_is_refused_for_good(tmp_path: Path) -> None:
    meter = Meter("backend")
    keeper = MapKeeper(MapStore(tmp_path / "map.seamark"), meter, patient=True)
    with pytest.raises(MapError, match="follows 6"):
        keeper.add_keyframe(replace(keyframe(7), previous_id=6))
    assert meter.status().counters == {"learning": 1}
    keeper.close()


def test_a_frozen_keeper_writes_nothing(tmp_path: Path) -> None:
    path, meter = tmp_path / "map.seamark", Meter("backend")
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
    before = path.read_bytes()
    keeper = MapKeeper(MapStore(path, read_only=True), meter, frozen=True)
    with pytest.raises(MapError, match="localises only"):
        keeper.add_keyframe(keyframe(1))
    done: Future[None] = Future()
    keeper.save([loop(0)], None, 0, done)
    assert done.done() and meter.status().counters == {"learning": 0}
    keeper.close()
    assert path.read_bytes() == before and [one.name for one in tmp_path.iterdir()] == ["map.seamark"]


def test_a_frozen_keeper_that_closes_never_becomes_the_writer(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Test: two services localise in one map, which is taken away. Expected: both end silently and make no new one."""
    path = tmp_path / "map.seamark"
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
    first, second = (MapKeeper(MapStore(path, read_only=True), Meter("backend"), frozen=True) for _ in range(2))
    first.close()
    path.unlink()
    second.close()
    assert list(tmp_path.iterdir()) == [] and caplog.records == []
