"""Maps of earlier versions: the golden old files come up to date, with all that was in them."""

import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.errors import MapCorruptError, MapVersionError
from seamark.backend.map_check import check_map
from seamark.backend.map_migrations import MIGRATIONS
from seamark.backend.map_reader import Verdict
from seamark.backend.map_repair import repair_map
from seamark.backend.map_schema import SCHEMA_VERSION
from seamark.backend.map_store import MapStore
from seamark.backend.types import Reason
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth

GOLDEN = Path(__file__).parent / "golden"


def old_rows(path: Path) -> list[sqlite3.Row]:
    database = sqlite3.connect(f"{path.as_uri()}?immutable=1", uri=True)
    database.row_factory = sqlite3.Row
    rows = database.execute("SELECT * FROM keyframes ORDER BY id").fetchall()
    database.close()
    return rows


def numbers(blob: bytes, dtype: str) -> np.ndarray:
    header, _, data = blob.partition(b"\n")
    return np.frombuffer(data, dtype).reshape([int(n) for n in header.split()[1:]])


def assert_is_the_golden_map(path: Path) -> None:
    with MapStore(path) as store:
        found = list(store.load_keyframes())
        old = old_rows(GOLDEN / "map_v1.seamark")
        assert [k.id for k in found] == [row["id"] for row in old] == [0, 1, 2, 3]
        for keyframe, row in zip(found, old, strict=True):
            assert (keyframe.session, keyframe.previous_id) == (row["session"], row["previous_id"])
            assert (keyframe.stamp_ns, keyframe.file, keyframe.index) == (
                row["stamp_ns"],
                row["file"],
                row["frame_index"],
            )
            assert (keyframe.jpeg, keyframe.metric) == (row["jpeg"], bool(row["metric"]))
            assert keyframe.camera is not None and keyframe.camera.distortion == (-0.25, 0.08, 0.001, -0.0005)
            np.testing.assert_array_equal(keyframe.features.descriptors, numbers(row["descriptors"], "u1"))
            np.testing.assert_array_equal(keyframe.features.points, numbers(row["points"], "<f4"))
            np.testing.assert_array_equal(keyframe.landmarks, numbers(row["landmarks"], "<f4"))
            np.testing.assert_array_equal(keyframe.thumbnail, numbers(row["thumbnail"], "u1"))
            np.testing.assert_array_equal(keyframe.T_odom_cam, numbers(row["T_odom_cam"], "<f8"))
            np.testing.assert_array_equal(keyframe.covariance, numbers(row["covariance"], "<f8"))
        refused, accepted = store.load_loops()
        assert (refused.query_id, refused.match_id, refused.reason) == (2, 0, Reason.FEW_MATCHES)
        assert np.isnan(refused.jeffrey) and refused.T_match_query is None
        assert (accepted.query_id, accepted.match_id, accepted.inliers, accepted.scale) == (3, 1, 80, 1.5)
        assert store.history(3, 1) == (Verdict(True, Reason.ACCEPTED, 3, 5),)
        poses = store.load_poses()
        assert {number: pose[1:] for number, pose in poses.items()} == {0: (0, 1), 1: (0, 1), 2: (0, 1.5), 3: (0, 1.5)}
        assert poses[3][0] is not None and poses[3][0][1, 3] == 2.25
        assert {session.id: session.component for session in store.load_sessions()} == {0: 0, 1: 0}
        assert store.meta() == {
            "config_hash": "0123456789abcdef",
            "mapped": "3",
            "mode": "mono",
            "revision": "5",
            "seamark": "0.1.0",
        }


def test_every_old_version_has_a_way_up() -> None:
    assert len(MIGRATIONS) == SCHEMA_VERSION - 1
    for version in range(1, SCHEMA_VERSION):
        assert (GOLDEN / f"map_v{version}.seamark").exists()


def test_version_1_is_brought_up_to_date_when_it_is_opened_for_writing(tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    shutil.copy(GOLDEN / "map_v1.seamark", path)
    with pytest.raises(MapVersionError, match="has map version 1"):
        MapStore(path, read_only=True)
    assert path.read_bytes() == (GOLDEN / "map_v1.seamark").read_bytes()
    assert_is_the_golden_map(path)
    assert check_map(path).problems == ()
    MapStore(path, read_only=True).close()


def test_a_damaged_old_map_is_refused_and_repaired(tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    shutil.copy(GOLDEN / "map_v1.seamark", path)
    assert repair_map(path, tmp_path / "new.seamark").damaged == []
    assert_is_the_golden_map(tmp_path / "new.seamark")
    with sqlite3.connect(path) as database:
        database.execute("UPDATE keyframes SET stamp_ns = 1 WHERE id = 1")
    database.close()
    before = path.read_bytes()
    with pytest.raises(MapCorruptError, match="row 1 of keyframes"):
        MapStore(path)
    assert path.read_bytes() == before
    report = repair_map(path, tmp_path / "other.seamark")
    assert report.damaged == ["row 1 of keyframes"]
    with MapStore(tmp_path / "other.seamark") as store:
        assert store.keyframe_ids() == [0, 2, 3] and store.load_loops()[0].match_id == 0


def test_version_3_is_brought_up_to_date_and_takes_depth(tmp_path: Path) -> None:
    """Test: the map of version 2 without three of its keyframes. Expected: as it was, and depth fits in."""
    path = tmp_path / "map.seamark"
    shutil.copy(GOLDEN / "map_v3.seamark", path)
    with pytest.raises(MapVersionError, match="has map version 3"):
        MapStore(path, read_only=True)
    saved = repair_map(path, tmp_path / "new.seamark")
    assert (saved.damaged, saved.lost, saved.mended) == ([], [], [])
    png = encode_depth(np.full((48, 64), 2000, np.uint16), 1000.0, FrontendConfig(keyframe_depth_px=160))
    for name in ("map.seamark", "new.seamark"):
        with MapStore(tmp_path / name) as store:
            assert store.keyframe_ids() == [0, 1, 3, 4, 5, 8, 9]
            assert store.keyframe(8).previous_id == 5 and store.load_spans()[8].steps == 3
            assert [(loop.query_id, loop.match_id, loop.accepted) for loop in store.load_loops()] == [
                (3, 1, True),
                (8, 3, True),
                (9, 4, False),
            ]
            assert store.keyframe(9).depth == b""
            store.add_keyframe(replace(store.keyframe(9), id=10, previous_id=9, depth=png))
            assert store.keyframe(10).depth == png and store.keyframe(10, ()).depth == b""
        assert check_map(tmp_path / name).problems == ()


def test_version_2_is_brought_up_to_date_with_all_its_views(tmp_path: Path) -> None:
    """Test: a map with three sessions, a loop that was withdrawn and came back, and two forgotten keyframes."""
    path = tmp_path / "map.seamark"
    shutil.copy(GOLDEN / "map_v2.seamark", path)
    with pytest.raises(MapVersionError, match="has map version 2"):
        MapStore(path, read_only=True)
    saved = repair_map(path, tmp_path / "new.seamark")
    assert (saved.damaged, saved.lost, saved.mended) == ([], [], [])
    for name in ("map.seamark", "new.seamark"):
        with MapStore(tmp_path / name) as store:
            assert store.keyframe_ids() == list(range(10))
            assert store.keyframe_ids(recognisable=True) == [0, 1, 2, 3, 4, 5, 8, 9]
            assert [verdict.accepted for verdict in store.history(8, 3)] == [True, False, True]
            evidence = store.evidence(8, 3)
            assert evidence is not None and evidence.inliers.tolist() == [True, True, False, True, True]
            assert {session.id: session.component for session in store.load_sessions()} == {0: 0, 1: 0, 4: 0}
            assert store.load_spans() == {} and store.load_means() == {}
            light = store.load_lightings()
            assert list(light) == [0, 1, 2, 3, 4, 5, 8, 9]
            thumbnail = store.keyframe(9).thumbnail.reshape(-1, 3) / 255
            np.testing.assert_allclose(light[9], [*thumbnail.mean(axis=0), *thumbnail.std(axis=0)], atol=1e-12)
        assert check_map(tmp_path / name).problems == ()


def test_version_4_is_brought_up_to_date_and_takes_an_adjustment(tmp_path: Path) -> None:
    """Test: the map of version 3 and a keyframe with depth. Expected: as it was, and what an adjustment finds fits."""
    path = tmp_path / "map.seamark"
    shutil.copy(GOLDEN / "map_v4.seamark", path)
    with pytest.raises(MapVersionError, match="has map version 4"):
        MapStore(path, read_only=True)
    saved = repair_map(path, tmp_path / "new.seamark")
    assert (saved.damaged, saved.lost, saved.mended) == ([], [], [])
    pose = AdjustedPose(np.eye(4), 1.0, 8, np.eye(6))
    for name in ("map.seamark", "new.seamark"):
        with MapStore(tmp_path / name) as store:
            assert store.keyframe_ids() == [0, 1, 3, 4, 5, 8, 9, 10]
            assert store.keyframe(8).previous_id == 5 and store.load_spans()[8].steps == 3
            assert len(store.keyframe(10).depth) > 50 and store.keyframe(9).depth == b""
            assert store.load_adjustments() == ()
            store.record(adjustments=[Adjustment(8, {8: pose, 9: pose}, {(8, 3): 0.5})])
            (found,) = store.load_adjustments()
            assert (list(found.poses), found.loops) == ([8, 9], {(8, 3): 0.5})
        assert check_map(tmp_path / name).problems == ()
