from collections.abc import Callable
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from seamark.frontend.types import Mode
from seamark.service.config import config_hash, load_config
from seamark.service.evaluation import Alignment
from seamark.service.report import build_report, compare, lost_spans, percentiles, report_table
from seamark.service.types import RunRecord, Trajectory

MakeRecord = Callable[..., RunRecord]


def test_every_item(make_record: MakeRecord) -> None:
    record, config = make_record(), load_config(None, {}, ["seed=3"])
    report = build_report(record, config)
    assert report["sources"] == ["../data/round"]
    assert report["mode"] == "rgbd"
    assert report["frames"]["total"] == 62
    assert report["frames"]["tracked"] == report["frames"]["in_trajectory"] == 60
    assert report["frames"]["by_outcome"] == {"lost": 1, "new_session": 1, "tracked": 59, "unreadable": 1}
    assert report["frames"]["by_loss"] == {"dark": 1}
    assert report["lost_spans"] == [
        {
            "from": "1700000003.000000001",
            "to": "1700000003.100000001",
            "frames": 2,
            "by_outcome": {"lost": 1, "unreadable": 1},
            "by_loss": {"dark": 1},
            "ended_by": "tracked",
        }
    ]
    assert report["sessions"] == [{"id": 0, "frames": 61, "keyframes": 12, "component": 0, "in_trajectory": True}]
    assert report["keyframes"] == 12
    assert report["loops"] == {"accepted": 1, "rejected": 2, "rejected_by_reason": {"few_matches": 1, "few_inliers": 1}}
    assert report["latency_ms"]["flow"] == {"count": 60, "p50": 5, "p95": 5, "p99": 5, "max": 5}
    assert report["latency_ms"]["verification"]["p50"] == 2
    assert report["frames_per_second"] == 20
    assert report["processes"][0] == {"name": "frontend", "peak_rss_bytes": 200 * 2**20, "cpu_s": 3.5}
    assert report["config_hash"] == config_hash(config)
    assert report["seed"] == 3
    assert {"seamark", "python", "numpy", "gtsam"} <= set(report["versions"])


def test_accuracy_with_its_alignment(make_record: MakeRecord) -> None:
    figures = build_report(make_record(), load_config())["accuracy"]
    assert figures["alignment"] == "se3"
    assert figures["ground_truth_length_m"] == pytest.approx(2 * np.pi * 12 + 1.25, rel=0.02)
    before, after = (figures[key]["ate"]["translation_m"]["rmse"] for key in ("odometry", "corrected"))
    assert 0.35 < before < 0.45
    assert 0.05 < after < 0.12
    assert [one["delta"] for one in figures["odometry"]["rpe"]] == ["1 frame", "1 m", "10 m"]
    # The drift of the fixture: 2 cm and 0.003 rad about an axis up to 24 m away, per frame.
    assert figures["odometry"]["rpe"][0]["rotation_deg"]["median"] == pytest.approx(np.degrees(0.003), rel=1e-3)
    mono = build_report(make_record(Mode.MONO), load_config())["accuracy"]
    assert mono["alignment"] == "sim3"
    assert mono["corrected"]["ate"]["scale"] == pytest.approx(0.8, rel=0.01)
    assert mono["odometry"]["ate"]["scale"] == pytest.approx(0.5, rel=0.02)


def test_what_cannot_be_measured_is_said(make_record: MakeRecord) -> None:
    record = make_record()
    assert build_report(replace(record, ground_truth=None), load_config())["accuracy"] is None
    assert build_report(make_record(Mode.PLACES), load_config())["accuracy"] is None
    assert record.ground_truth is not None
    other_time = replace(record.ground_truth, stamps_ns=record.ground_truth.stamps_ns + 10**15)
    figures = build_report(replace(record, ground_truth=other_time), load_config())["accuracy"]
    assert "ground truth" in figures["odometry"]["error"]
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert compare(nothing, record.ground_truth, Alignment.SE3) == {"error": "no frame has a pose"}


def test_spans_end_where_a_pose_is_found(make_record: MakeRecord) -> None:
    frames = make_record().odometry
    assert lost_spans(frames[:30]) == []
    twice = (*frames[29:33], *frames[30:32])
    assert [(span["frames"], span["ended_by"]) for span in lost_spans(twice)] == [(2, "tracked"), (2, None)]
    assert lost_spans(make_record(Mode.MONO).odometry[:5]) == []


def test_percentiles_leave_nan_out() -> None:
    assert percentiles([float("nan")]) == {"count": 0, "p50": None, "p95": None, "p99": None, "max": None}
    figures = percentiles([*range(101), float("nan")])
    assert figures == {"count": 101, "p50": 50, "p95": 95, "p99": 99, "max": 100}


def test_frames_apart_from_the_trajectory_are_told(make_record: MakeRecord) -> None:
    record = make_record()
    apart = (record.snapshot.keyframe_ids >= 9).astype(np.int64)
    report = build_report(replace(record, snapshot=replace(record.snapshot, components=apart)), load_config())
    assert (report["frames"]["tracked"], report["frames"]["in_trajectory"]) == (60, 43)
    stream = StringIO()
    Console(file=stream, width=160).print(report_table(report))
    assert "60 of 62 with a pose, 17 of them apart from the trajectory" in stream.getvalue()


@pytest.mark.parametrize("mode", list(Mode))
def test_table(make_record: MakeRecord, mode: Mode) -> None:
    stream = StringIO()
    Console(file=stream, width=160).print(report_table(build_report(make_record(mode), load_config())))
    text = stream.getvalue()
    assert "../data/round" in text
    assert "1 accepted, 2 rejected (few_matches 1, few_inliers 1)" in text
    assert ("ATE 0.3915 m" in text) == (mode in (Mode.RGBD, Mode.STEREO))
