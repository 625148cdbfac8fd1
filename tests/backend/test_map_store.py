"""The map on disk: what is written is read, damage is found, and kill -9 loses nothing acknowledged."""

import os
import sqlite3
import threading
import time
from dataclasses import fields, replace

import numpy as np
import pytest

from seamark.backend import map_file
from seamark.backend.errors import MapCorruptError, MapError, MapInUseError, MapVersionError
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason


@pytest.fixture
def keyframe(make_keyframe):
    return make_keyframe


def assert_same(a, b):
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if f.name == "features":
            assert_same(x, y)
        elif isinstance(x, np.ndarray):
            assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), f.name
        elif isinstance(x, float) and np.isnan(x):
            assert np.isnan(y), f.name
        else:
            assert (type(x), x) == (type(y), y), f.name


def test_everything_comes_back_to_the_bit(tmp_path, keyframe):
    path = tmp_path / "map.seamark"
    first, second = keyframe(0), keyframe(1)
    bare = replace(keyframe(2), camera=None, T_odom_cam=None, covariance=None, metric=False)
    loops = (
        Loop(1, 0, True, Reason.ACCEPTED, 80, 0.5, 0.25, 0.125, np.eye(4), np.eye(6), 1.5),
        Loop(2, 0, False, Reason.FEW_MATCHES, 0, 0.1, 0.2, float("nan")),
    )
    snapshot = MapSnapshot(
        7,
        np.array([0, 1, 2]),
        np.array([1, 1, 1]),
        np.array([1, 1, 1]),
        np.stack([np.eye(4), 2 * np.eye(4), np.full((4, 4), np.nan)]),
        np.array([1.0, 1.25, 1.0]),
        loops,
    )
    with MapStore(path) as store:
        store.set_meta({"mode": "rgbd", "vocabulary": "abc"})
        for k in (first, second, bare):
            store.add_keyframe(k)
        store.add_loop(replace(loops[0], accepted=False, reason=Reason.UNCONFIRMED))
        store.add_loops(loops)
        store.update_poses(snapshot)
    assert [p.name for p in tmp_path.iterdir()] == ["map.seamark"]
    with MapStore(path, read_only=True) as store:
        for expected, found in zip((first, second, bare), store.load_keyframes(), strict=True):
            assert_same(expected, found)
        for expected_loop, found_loop in zip(loops, store.load_loops(), strict=True):
            assert_same(expected_loop, found_loop)
        poses = store.load_poses()
        np.testing.assert_array_equal(poses[1][0], 2 * np.eye(4))
        assert poses[1][1:] == (1, 1.25)
        assert poses[2][0] is None
        assert store.meta() == {"mode": "rgbd", "vocabulary": "abc", "revision": "7"}
        with pytest.raises(MapError, match="no keyframe 9"):
            store.keyframe(9)
        with pytest.raises(MapError, match="cannot be written"):
            store.add_keyframe(first)


def test_damage_is_found_and_named(tmp_path, keyframe):
    path = tmp_path / "map.seamark"
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
        store.add_keyframe(keyframe(1))
        store.add_loop(Loop(1, 0, True, Reason.ACCEPTED, 80, 0.5, 0.25, 0.125))
    descriptors = keyframe(1).features.descriptors.tobytes()
    data = bytearray(path.read_bytes())
    at = data.index(descriptors[:64])
    data[at] ^= 1
    path.write_bytes(data)
    with MapStore(path) as store:
        assert store.keyframe(0).id == 0
        with pytest.raises(MapCorruptError, match="keyframe 1 "):
            store.keyframe(1)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE loops SET inliers = 81")
    database.close()
    with MapStore(path) as store, pytest.raises(MapCorruptError, match="loop 1 to 0"):
        store.load_loops()


def test_strangers_are_not_taken_for_maps(tmp_path):
    text, other, newer = tmp_path / "a.txt", tmp_path / "b.sqlite", tmp_path / "c.seamark"
    text.write_text("not a data base at all\n" * 100)
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE t (x)")
    database.close()
    MapStore(newer).close()
    with sqlite3.connect(newer) as database:
        database.execute("PRAGMA user_version = 99")
    database.close()
    for path, words in ((text, "is no map"), (other, "is no map"), (newer, "map version 99")):
        before = path.read_bytes()
        with pytest.raises(MapVersionError, match=words):
            MapStore(path)
        assert path.read_bytes() == before
    with pytest.raises(MapError, match="there is no map"):
        MapStore(tmp_path / "missing.seamark", read_only=True)
    with pytest.raises(MapError, match="cannot be opened"):
        MapStore(tmp_path / "no" / "folder.seamark")


def test_a_full_disk_is_an_error_and_keeps_what_was_there(tmp_path, keyframe):
    path = tmp_path / "map.seamark"
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
        store.file.database.execute("PRAGMA max_page_count = 60")
        with pytest.raises(MapError, match="full"):
            for number in range(1, 50):
                store.add_keyframe(replace(keyframe(number), jpeg=os.urandom(100_000)))
        assert_same(keyframe(0), store.keyframe(0))
    with MapStore(path, read_only=True) as store:
        assert_same(keyframe(0), next(iter(store.load_keyframes())))


def test_nobody_reads_a_closed_file_while_a_reader_tries_to_become_the_writer(tmp_path, keyframe, monkeypatch):
    """Test: another reader is in the way, so that it fails, while a thread reads. Expected: each reading succeeds."""
    monkeypatch.setattr(map_file, "READERS_PATIENCE_S", 0.1)
    path = tmp_path / "map.seamark"
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
    read, ended = [], threading.Event()
    with MapStore(path, read_only=True) as store, MapStore(path, read_only=True):

        def read_on():
            while not ended.is_set():
                try:
                    read.append(len(store.keyframe(0).features))
                except MapError as error:
                    read.append(error)

        thread = threading.Thread(target=read_on)
        thread.start()
        for _ in range(3):
            with pytest.raises(MapInUseError):
                store.take_over()
            time.sleep(0.02)
        ended.set()
        thread.join()
    assert len(read) > 3
    assert set(read) == {len(keyframe(0).features)}


def test_a_reader_beside_the_writer_keeps_nobody_out_and_sees_what_is_written(tmp_path, keyframe):
    path = tmp_path / "map.seamark"
    with MapStore(path) as store:
        store.add_keyframe(keyframe(0))
    with MapStore(path, read_only=True), pytest.raises(MapInUseError):
        MapStore(path)
    with MapStore(path, read_only=True, beside_writer=True) as reader, MapStore(path) as writer:
        writer.add_keyframe(keyframe(1))
        assert reader.keyframe_ids() == [0, 1]
        with pytest.raises(MapError):
            reader.add_keyframe(keyframe(2))
    with MapStore(path, read_only=True) as reader:
        assert reader.keyframe_ids() == [0, 1]
