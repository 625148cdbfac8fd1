import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun
from rerun.chunk import RrdReader

from seamark.frontend.camera import Camera, Rig
from seamark.frontend.types import Features, Frame, Keyframe, Mode
from seamark.service import recorder as recorder_module
from seamark.service.recorder import NullRecorder, Recorder, RerunRecorder
from seamark.service.sources.base import Unreadable
from seamark.service.types import RunRecord

MakeRecord = Callable[..., RunRecord]
RIG = Rig(Camera(1280, 720, 900, 900, 640, 360))


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rerun.set_strict_mode(True)
    yield
    rerun.set_strict_mode(False)


def image(k: int) -> np.ndarray:
    return np.roll(np.add.outer(np.arange(720), np.arange(1280)).astype(np.uint8), 8 * k, axis=1)


def keyframe(record: RunRecord, id_: int) -> Keyframe:
    summary = next(one for one in record.keyframes if one.id == id_)
    jpeg = cv2.imencode(".jpg", image(summary.index))[1].tobytes()
    T = record.odometry[summary.index].T_odom_cam
    empty = Features.empty()
    return Keyframe(
        *(id_, 0, summary.index, summary.stamp_ns, summary.file, empty),
        landmarks=np.zeros((0, 3), np.float32),
        thumbnail=np.zeros((4, 4), np.uint8),
        jpeg=jpeg,
        T_odom_cam=T,
    )


def play(recorder: Recorder, record: RunRecord) -> None:
    ids = {one.index: one.id for one in record.keyframes}
    for odometry in record.odometry:
        k = odometry.index
        frame: Frame | Unreadable = Frame(k, odometry.stamp_ns, image(k), file=odometry.file)
        if k == 30:
            frame = Unreadable(k, odometry.stamp_ns, odometry.file, "030.png is truncated")
        recorder.frame(frame, odometry)
        if k in ids:
            recorder.keyframe(keyframe(record, ids[k]))
    recorder.finish(record)


def read(path: Path) -> tuple[Counter[str], dict[str, list[Any]]]:
    counts: Counter[str] = Counter()
    batches: dict[str, list[Any]] = {}
    reader = RrdReader(str(path))
    assert [entry.application_id for entry in reader.recordings()] == ["seamark"]
    assert len(reader.blueprints()) == 1
    for chunk in reader.stream():
        counts[chunk.entity_path] += chunk.num_rows
        batches.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return counts, batches


def values(batches: list[Any], ending: str) -> list[Any]:
    return [
        value
        for batch in batches
        for name in batch.schema.names
        if name.endswith(ending)
        for value in batch.column(name).to_pylist()
        if value is not None
    ]


def test_everything_is_in_the_file(tmp_path: Path, make_record: MakeRecord) -> None:
    record, path = make_record(), tmp_path / "run.rrd"
    play(RerunRecorder(path, name="round", mode=Mode.RGBD, rig=RIG), record)
    counts, batches = read(path)
    assert counts["/world/cam"] == 60
    assert counts["/plots/inliers"] == 62 + 1  # and their style
    assert counts["/plots/latency_ms"] == 60 + 1
    blobs = values(batches["/world/cam/image"], "EncodedImage:blob")
    assert len(blobs) == 61
    picture = cv2.imdecode(np.array(blobs[3][0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (360, 640)
    np.testing.assert_allclose(values(batches["/world/cam/image"], "Pinhole:resolution")[0][0], [640, 360])
    points = values(batches["/world/cam/image/points"], "Points2D:positions")
    np.testing.assert_allclose(points[0], [[5.25, 10.25], [15.25, 20.25]])
    assert sum(name.startswith("/world/odometry/way/") for name in counts) == 1
    for entity in ("trajectory", "keyframes", "loops", "cam"):
        assert counts[f"/world/map/{entity}"] >= 1
    assert len(values(batches["/world/map/trajectory"], "strips")[0][0]) == 60
    assert counts["/world/odometry_in_map"] == 1
    pair = cv2.imdecode(np.array(values(batches["/loops/accepted/pair"], "blob")[0][0], np.uint8), cv2.IMREAD_COLOR)
    assert pair is not None
    assert pair.shape == (180 + 8, 2 * 320 + 12, 3)
    assert counts["/loops/rejected/pair"] == 2
    assert [value[0] for value in values(batches["/plots/loop_inliers"], "Scalars:scalars")] == [3, 9, 150]
    assert any("truncated" in text[0] for text in values(batches["/logs"], "TextLog:text"))


def test_loops_stand_at_the_time_of_their_query(tmp_path: Path, make_record: MakeRecord) -> None:
    record, path = make_record(), tmp_path / "run.rrd"
    play(RerunRecorder(path, name="round", mode=Mode.RGBD, rig=RIG), record)
    _, batches = read(path)
    (batch,) = batches["/loops/accepted/pair"]
    assert batch.column("frame").to_pylist() == [60]
    stamps = batch.column("capture_time").cast("int64").to_pylist()
    assert stamps == [record.odometry[60].stamp_ns]


def test_the_way_does_not_grow_with_the_square(
    tmp_path: Path, make_record: MakeRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "PIECE_FRAMES", 8)
    record, path = make_record(), tmp_path / "run.rrd"
    play(RerunRecorder(path, name="round", mode=Mode.RGBD, rig=RIG), record)
    _, batches = read(path)
    pieces = sorted(name for name in batches if name.startswith("/world/odometry/way/"))
    last = [values(batches[name], "strips")[-1][0] for name in pieces]
    assert max(len(piece) for piece in last) <= 9
    for before, after in pairwise(last):
        assert before[-1] == after[0]
    given = [frame.T_odom_cam[:3, 3] for frame in record.odometry if frame.T_odom_cam is not None]
    np.testing.assert_allclose([*last[0], *(p for piece in last[1:] for p in piece[1:])], given, atol=1e-5)


def test_places(tmp_path: Path, make_record: MakeRecord) -> None:
    record, path = make_record(Mode.PLACES), tmp_path / "run.rrd"
    play(RerunRecorder(path, name="places", mode=Mode.PLACES, rig=None), record)
    counts, _ = read(path)
    assert counts["/loops/accepted/pair"] == 1
    assert "/world/cam" not in counts


def test_many_frames_of_reference_and_empty_runs(tmp_path: Path, make_record: MakeRecord) -> None:
    record = make_record()
    split = (record.snapshot.keyframe_ids >= 9).astype(np.int64)
    snapshot = replace(record.snapshot, components=split, sessions=split)
    play(RerunRecorder(tmp_path / "a.rrd", name="a", mode=Mode.RGBD, rig=RIG), replace(record, snapshot=snapshot))
    recorder = RerunRecorder(tmp_path / "b.rrd", name="b", mode=Mode.RGBD, rig=RIG)
    recorder.close()
    recorder.close()
    assert (tmp_path / "b.rrd").stat().st_size > 0


def test_null_recorder_does_nothing(make_record: MakeRecord) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recorder: Recorder = NullRecorder()
        play(recorder, make_record())
        recorder.close()
