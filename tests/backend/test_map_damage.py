"""Damaged maps: the check finds every flipped byte, the repair saves what is whole and says what is not."""

import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.errors import MapError
from seamark.backend.evidence import Evidence, Gate
from seamark.backend.graph_types import Span
from seamark.backend.map_carve import carve
from seamark.backend.map_check import check_map
from seamark.backend.map_codec import encode_span, sealed
from seamark.backend.map_repair import repair_map
from seamark.backend.map_schema import COLUMNS, upsert
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth
from seamark.frontend.types import Keyframe

COUNT = 60
DEPTH = encode_depth(np.full((24, 32), 2000, np.uint16), 1000.0, FrontendConfig(keyframe_depth_px=160))
PAGE = 4096


@pytest.fixture(scope="module")
def template(make_keyframe: Callable[[int], Keyframe]) -> Keyframe:
    return make_keyframe(0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, template: Keyframe) -> Path:
    """A map of two sessions of 30 keyframes each, 20 loops of which one was withdrawn, and a pruned keyframe."""
    path = tmp_path_factory.mktemp("whole") / "map.seamark"
    rng = np.random.default_rng(4)
    with MapStore(path) as store:
        store.set_meta({"mode": "rgbd", "mapped": str(COUNT - 1)})
        for number in range(COUNT):
            T = np.eye(4)
            T[:3, 3] = (0.25 * number, 0, 0)
            previous = number - 1 if number % 30 else None
            jpeg = rng.bytes(6000)
            session = number // 30
            store.add_keyframe(
                replace(
                    template, id=number, session=session, previous_id=previous, T_odom_cam=T, jpeg=jpeg, depth=DEPTH
                )
            )
        seen = Evidence(np.ones((80, 4), np.float32), np.ones(80, bool), (Gate("inliers", 80, 15),))
        store.add_loops(
            Loop(30 + n, n, True, Reason.ACCEPTED, 80, 1.0, 0.25, 0.125, np.eye(4), np.eye(6)) for n in range(1, 20)
        )
        store.add_loop(Loop(30, 0, True, Reason.ACCEPTED, 80, 1.0, 0.25, 0.125, np.eye(4), np.eye(6), evidence=seen))
        store.add_loop(Loop(31, 1, False, Reason.INCONSISTENT, 80, 1.0, 0.25, 0.125, np.eye(4), np.eye(6)))
        ids = np.arange(COUNT)
        T_map = np.tile(np.eye(4), (COUNT, 1, 1))
        T_map[:, 0, 3] = ids
        store.update_poses(MapSnapshot(9, ids, ids // 30, ids * 0, T_map, np.ones(COUNT), ()))
        with store.file.writing() as database:  # as earlier versions forgot
            for table in ("images", "depths", "landmarks", "features"):
                database.executemany(f"DELETE FROM {table} WHERE keyframe_id = ?", [(number,) for number in [5]])
            span = Span(3, 0.5, 1.25, np.diag([1e-4] * 6))
            database.execute(upsert("spans"), sealed("spans", encode_span(7, span)))
            key = database.execute("SELECT query_id, match_id FROM loops ORDER BY 1, 2").fetchone()
            database.execute(upsert("composed"), sealed("composed", (*key, 2, 0.001)))
        eye = AdjustedPose(np.eye(4), 1.0, 7, np.eye(6))
        store.record(adjustments=[Adjustment(8, {8: eye, 9: replace(eye, previous_id=8)}, {(31, 1): 0.5})])
    return path


def rows_of(path: Path) -> dict[str, list[tuple[object, ...]]]:
    with sqlite3.connect(path) as database:
        rows = {table: database.execute(f"SELECT * FROM {table} ORDER BY 1, 2").fetchall() for table in COLUMNS}
    database.close()
    return rows


def test_a_whole_map_is_whole(whole: Path, tmp_path: Path) -> None:
    report = check_map(whole)
    assert report.problems == ()
    assert report.rows == {
        "views": 59,
        "depths": 59,
        "spans": 1,
        "composed": 1,
        "adjusted": 2,
        "adjusted_loops": 1,
        "meta": 3,
        "sessions": 2,
        "cameras": 1,
        "keyframes": 60,
        "edges": 60,
        "features": 59,
        "landmarks": 59,
        "images": 59,
        "poses": 60,
        "loops": 20,
        "evidence": 1,
        "history": 21,
    }
    repaired = repair_map(whole, tmp_path / "new.seamark")
    assert repaired.damaged == repaired.lost == repaired.mended == []
    assert repaired.saved == report.rows
    assert rows_of(tmp_path / "new.seamark") == rows_of(whole)
    with pytest.raises(MapError, match="exists"):
        repair_map(whole, tmp_path / "new.seamark")


def test_rows_are_found_without_the_tables_around_them(whole: Path) -> None:
    found: dict[str, set[tuple[object, ...]]] = {table: set() for table in COLUMNS}
    for table, values in carve(whole):
        found[table].add(values)
    for table, rows in rows_of(whole).items():
        assert {row[:-1] for row in rows} <= found[table], table


@pytest.mark.parametrize("seed", range(12))
def test_flipped_bits_are_found_and_what_they_hit_is_all_that_is_lost(seed: int, whole: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path / "map.seamark"
    data = bytearray(whole.read_bytes())
    hit = set()
    for at in rng.integers(100, len(data), 3):
        data[at] ^= 1 << int(rng.integers(8))
        hit.add(int(at) // PAGE)
    path.write_bytes(data)
    try:
        problems = check_map(path).problems
    except MapError as error:
        problems = (str(error),)
    report = repair_map(path, tmp_path / "new.seamark")
    assert check_map(tmp_path / "new.seamark").problems == ()
    before, after = rows_of(whole), rows_of(tmp_path / "new.seamark")
    changed = {table for table in COLUMNS if before[table] != after[table]}
    if changed:  # a flip may lie in free space, in an index or in an inner page
        assert problems and (report.damaged or report.lost)
    assert len(after["keyframes"]) >= 60 - 25 * len(hit)  # one page of keyframes holds no more
    for table in ("features", "images"):
        same = set(before[table]) & set(after[table])
        assert len(same) >= 59 - (60 - len(after["keyframes"])) - 3, table


@pytest.mark.parametrize("share", [0.5, 0.7, 0.95])
def test_what_lies_before_the_end_of_a_truncated_map_is_saved(share: float, whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    data = whole.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    report = repair_map(path, tmp_path / "new.seamark")
    assert check_map(tmp_path / "new.seamark").problems == ()
    kept = {int(row[0]) for row in rows_of(tmp_path / "new.seamark")["images"]}  # type: ignore[call-overload]
    assert share * 60 - 18 <= len(kept) <= share * 60 + 8  # one page of keyframes holds 16
    assert report.lost and report.damaged


def test_a_destroyed_beginning_leaves_the_rest(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    data = whole.read_bytes()
    path.write_bytes(bytes(2 * PAGE) + data[2 * PAGE :])
    with pytest.raises(MapError):
        check_map(path)
    report = repair_map(path, tmp_path / "new.seamark")
    assert report.saved["keyframes"] == 60 and report.saved["features"] >= 58
    before, after = rows_of(whole), rows_of(tmp_path / "new.seamark")
    assert before["keyframes"] == after["keyframes"] and before["loops"] == after["loops"]


def test_a_lost_page_of_keyframes_is_bridged(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    shutil.copy(whole, path)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE keyframes SET file = 'other' WHERE id IN (10, 11)")
    database.close()
    problems = check_map(path).problems
    assert len(problems) == 2 and all("keyframe 1" in one for one in problems)
    report = repair_map(path, tmp_path / "new.seamark")
    # The file still has a stale page of neither: they are gone, with all that hangs on them.
    assert report.damaged == ["keyframe 10", "keyframe 11"]
    assert report.lost == ["2 keyframes: 10, 11", "1 loops: 40 to 10", "1 loops: 41 to 11"] or report.lost == [
        "2 keyframes: 10, 11",
        "2 loops: 40 to 10, 41 to 11",
        "2 rows of history, of loops that are lost",
        "1 keyframes have no features (or were pruned): 5",
        "1 keyframes have no landmarks (or were pruned): 5",
        "1 keyframes have no images (or were pruned): 5",
    ]
    assert report.mended == ["1 keyframes hang on an earlier one of their session: 12"]
    with MapStore(tmp_path / "new.seamark") as store:
        nodes = {node.id: node for node in store.load_nodes()}
        assert nodes[12].previous_id == 9 and nodes[13].previous_id == 12
        np.testing.assert_allclose(np.diag(nodes[12].covariance), 3 * np.diag(nodes[13].covariance))  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [15, 17, 20, 33, 35, 99, 107, 108])
def test_of_a_map_cut_off_in_its_header_nothing_can_be_saved(size: int, whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.seamark"
    path.write_bytes(whole.read_bytes()[:size])
    with pytest.raises(MapError, match="nothing could be saved"):
        repair_map(path, tmp_path / "new.seamark")
    assert list(tmp_path.glob("new*")) == []


def test_nothing_to_save_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "map.seamark"
    path.write_bytes(bytes(10 * PAGE))
    with pytest.raises(MapError, match="nothing could be saved"):
        repair_map(path, tmp_path / "new.seamark")
    assert [one.name for one in tmp_path.iterdir()] == ["map.seamark"]
