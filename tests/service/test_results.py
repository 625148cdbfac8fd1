import csv
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from seamark.backend.types import Loop, Reason
from seamark.frontend import se3
from seamark.frontend.types import Loss, Mode, Odometry, Outcome, Quality
from seamark.service import trajectories
from seamark.service.config import load_config
from seamark.service.evaluation import ate, load_tum
from seamark.service.output import STAGING_PREFIX, OutputError, prepare_output
from seamark.service.results import frame_row, loop_row, number, pose_fields, tum_text, write_results
from seamark.service.stamps import format_stamp, parse_stamp
from seamark.service.types import KeyframeSummary, RunRecord, Trajectory

MakeRecord = Callable[..., RunRecord]
FILES = {
    *("trajectory.tum", "odometry.tum", "keyframes.tum", "frames.csv", "loops.csv"),
    *("report.json", "config.yaml", "trajectory.png"),
}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


class TestGoldenFormats:
    """What is written here is a contract: these texts may gain columns, nothing in them may change."""

    def test_tum(self) -> None:
        T = np.stack(
            [
                np.eye(4),
                se3.make(se3.exp_rotation(np.array([0, 0, np.pi / 2])), np.array([1 / 3, -2e-7, 12345.6789012])),
            ]
        )
        text = tum_text(Trajectory(np.array([1, 1_700_000_000_123_456_789], np.int64), T))
        assert text == (
            "# stamp tx ty tz qx qy qz qw\n"
            "0.000000001 0 0 0 0 0 0 1\n"
            "1700000000.123456789 0.333333333 -2e-07 12345.6789 0 0 0.707106781 0.707106781\n"
        )

    def test_frame_rows(self) -> None:
        frame = Odometry(3, 1_500_000_000, "rgb/a,b.png", 0, Quality.GOOD, Outcome.TRACKED, 87, 0.123456789, 9.87654321)
        row = ["1.500000000", "rgb/a,b.png", "0", "good", "87", "0.123457", "9.87654", "tracked"]
        assert frame_row(frame) == [*row, "", ""]
        assert frame_row(replace(frame, near_share=0.98765))[8:] == ["", "0.988"]
        assert frame_row(frame, timed=False)[6] == ""
        lost = Odometry(4, 2_000_000_000, "x", -1, Quality.LOST, Outcome.UNREADABLE)
        assert frame_row(lost) == ["2.000000000", "x", "-1", "lost", "0", "", "", "unreadable", "", ""]
        assert frame_row(replace(lost, outcome=Outcome.LOST, loss=Loss.BRIGHT))[7:] == ["lost", "bright", ""]

    def test_loop_rows(self) -> None:
        keyframes = {k: KeyframeSummary(k, 0, k, k * 10**9, f"{k}.png") for k in (1, 8)}
        T = se3.make(np.eye(3), np.array([0.5, -0.0, 2]))
        accepted = Loop(8, 1, True, Reason.ACCEPTED, 40, 0.5, 1 / 3, 0.25, T)
        assert loop_row(accepted, keyframes) == (
            [
                "8.000000000",
                "1.000000000",
                "8.png",
                "1.png",
                "1",
                "accepted",
                "0.5",
                "0.333333333",
                "0.25",
                "40",
                "0.5",
                "0",
                "2",
                "0",
                "0",
                "0",
                "1",
            ]
        )
        rejected = Loop(8, 1, False, Reason.FEW_MATCHES, 0, 0.5, 0.25, float("nan"))
        assert loop_row(rejected, keyframes)[4:] == ["0", "few_matches", "0.5", "0.25", "", "0"] + [""] * 7

    def test_columns(self, tmp_path: Path, make_record: MakeRecord) -> None:
        write_results(make_record(), tmp_path, load_config())
        assert (tmp_path / "frames.csv").read_text().splitlines()[:2] == [
            "stamp,file,session,quality,inliers,reprojection_px,latency_ms,outcome,loss,near_share",
            "1700000000.000000001,rgb/000.png,0,marginal,100,0.5,10,new_session,,",
        ]
        assert (tmp_path / "loops.csv").read_text().splitlines()[0] == (
            "query_stamp,match_stamp,query_file,match_file,accepted,reason,score,votes,jeffrey,inliers,tx,ty,tz,qx,qy,qz,qw"
        )
        assert (tmp_path / "loops.csv").read_text().splitlines()[1] == (
            "1700000003.500000001,1700000001.000000001,rgb/035.png,rgb/010.png,0,few_matches,0.125,0.0625,0.5,3,,,,,,,"
        )

    @pytest.mark.parametrize("stamp", [0, 1, -1, 999_999_999, -1_500_000_000, 1_403_715_273_262_142_976])
    def test_stamps_are_exact(self, stamp: int) -> None:
        assert parse_stamp(format_stamp(stamp)) == stamp
        assert len(format_stamp(stamp).split(".")[1]) == 9

    def test_scientific_stamps_and_nonsense(self) -> None:
        assert parse_stamp("1.037359e-01") == 103_735_900
        for text in ("nan", "inf", "", "1,5"):
            with pytest.raises(ValueError, match="is not a stamp"):
                parse_stamp(text)

    def test_numbers(self) -> None:
        assert [number(x, 9) for x in (-0.0, float("nan"), float("inf"), 1e-12)] == ["0", "", "", "1e-12"]
        assert pose_fields(None) == pose_fields(np.full((4, 4), np.nan)) == [""] * 7


class TestContent:
    def test_all_files_and_nothing_else(self, tmp_path: Path, make_record: MakeRecord) -> None:
        out = tmp_path / "a" / "b"
        write_results(make_record(), out, load_config())
        assert {path.name for path in out.iterdir()} == FILES
        assert (out / "trajectory.png").read_bytes().startswith(b"\x89PNG")
        assert yaml.safe_load((out / "config.yaml").read_text())["seed"] == 0

    def test_trajectories_read_back(self, tmp_path: Path, make_record: MakeRecord) -> None:
        record = make_record()
        write_results(record, tmp_path, load_config())
        trajectory, odometry = load_tum(tmp_path / "trajectory.tum"), load_tum(tmp_path / "odometry.tum")
        assert len(trajectory) == len(odometry) == 60  # of 62, one unreadable, one lost
        keyframes = load_tum(tmp_path / "keyframes.tum")
        assert len(keyframes) == 12
        np.testing.assert_allclose(keyframes.T_world_cam, record.snapshot.T_map_cam, atol=1e-7)
        given = {frame.stamp_ns: frame.T_odom_cam for frame in record.odometry}
        for stamp, T in zip(odometry.stamps_ns, odometry.T_world_cam, strict=True):
            expected = given[int(stamp)]
            assert expected is not None
            np.testing.assert_allclose(T, expected, atol=1e-7)
        # At keyframes the corrected trajectory is the map; between them it keeps the odometry's small motions.
        at = {int(s): T for s, T in zip(trajectory.stamps_ns, trajectory.T_world_cam, strict=True)}
        for stamp, T in zip(keyframes.stamps_ns, keyframes.T_world_cam, strict=True):
            np.testing.assert_allclose(at[int(stamp)], T, atol=1e-6)

    def test_frames_csv_has_every_frame_in_input_order(self, tmp_path: Path, make_record: MakeRecord) -> None:
        write_results(make_record(), tmp_path, load_config())
        table = rows(tmp_path / "frames.csv")
        assert [row["file"] for row in table] == [f"rgb/{k:03d}.png" for k in range(62)]
        assert [(r["outcome"], r["session"]) for r in table[30:32]] == [("unreadable", "-1"), ("lost", "0")]

    def test_mono_takes_the_scale_of_the_session_and_filled_frames(
        self, tmp_path: Path, make_record: MakeRecord
    ) -> None:
        record = make_record(Mode.MONO)
        write_results(record, tmp_path, load_config())
        mono, metric = load_tum(tmp_path / "trajectory.tum"), trajectories.corrected(make_record())
        assert len(load_tum(tmp_path / "odometry.tum")) == 57
        assert mono.stamps_ns.tolist() == metric.stamps_ns.tolist()
        np.testing.assert_allclose(mono.T_world_cam[:, :3, 3], 1.25 * metric.T_world_cam[:, :3, 3], atol=1e-6)
        assert ate(mono, metric, "sim3").scale == pytest.approx(0.8)

    def test_only_the_larger_frame_of_reference_is_written(self, make_record: MakeRecord) -> None:
        record = make_record()
        split = (record.snapshot.keyframe_ids >= 9).astype(np.int64)
        record = replace(record, snapshot=replace(record.snapshot, components=split, sessions=split))
        trajectory = trajectories.corrected(record)
        assert len(trajectory) == 43
        assert len(trajectories.keyframes(record)) == 8
        flipped = replace(record, snapshot=replace(record.snapshot, components=1 - split))
        assert trajectories.main_component(flipped) == 1
        small_first = replace(record, snapshot=replace(record.snapshot, components=(split == 0).astype(np.int64)))
        np.testing.assert_array_equal(trajectories.corrected(small_first).stamps_ns, trajectory.stamps_ns)

    def test_places_have_no_poses(self, tmp_path: Path, make_record: MakeRecord) -> None:
        write_results(make_record(Mode.PLACES), tmp_path, load_config())
        for name in ("trajectory.tum", "odometry.tum", "keyframes.tum"):
            assert (tmp_path / name).read_text() == "# stamp tx ty tz qx qy qz qw\n"
        accepted = [row for row in rows(tmp_path / "loops.csv") if row["accepted"] == "1"]
        assert [row["match_file"] for row in accepted] == ["rgb/000.png"]
        assert {row[c] for row in rows(tmp_path / "loops.csv") for c in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")} == {
            ""
        }

    def test_nothing_at_all(self, tmp_path: Path, make_record: MakeRecord) -> None:
        record = make_record()
        empty = np.zeros(0, np.int64)
        snapshot = replace(
            record.snapshot,
            **dict.fromkeys(("keyframe_ids", "sessions", "components"), empty),
            T_map_cam=np.zeros((0, 4, 4)),
            scales=np.zeros(0),
            loops=(),
        )
        for mode in Mode:
            write_results(
                replace(record, mode=mode, odometry=(), keyframes=(), snapshot=snapshot), tmp_path, load_config()
            )
        assert (tmp_path / "trajectory.tum").read_text() == "# stamp tx ty tz qx qy qz qw\n"

    def test_deterministic_runs_are_equal_to_the_byte(self, tmp_path: Path, make_record: MakeRecord) -> None:
        first, second = make_record(deterministic=True), make_record(deterministic=True)
        slower = tuple(replace(frame, latency_ms=frame.latency_ms * 2) for frame in second.odometry)
        write_results(first, tmp_path / "1", load_config())
        write_results(replace(second, odometry=slower, wall_s=9.0), tmp_path / "2", load_config())
        for name in sorted(name for name in FILES if name.endswith((".tum", ".csv"))):
            assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


class TestOutput:
    def test_nothing_half_written(self, tmp_path: Path, make_record: MakeRecord) -> None:
        broken = replace(make_record(), snapshot=replace(make_record().snapshot, loops=(None,)))  # type: ignore[arg-type]
        with pytest.raises(AttributeError):
            write_results(broken, tmp_path / "new", load_config())
        assert not (tmp_path / "new").exists()
        write_results(make_record(), tmp_path / "old", load_config())
        before = {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()}
        with pytest.raises(AttributeError):
            write_results(broken, tmp_path / "old", load_config())
        assert {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()} == before

    def test_commit_replaces_results_and_leaves_other_files(self, tmp_path: Path) -> None:
        (tmp_path / "notes.txt").write_text("mine")
        (tmp_path / "report.json").write_text("old")
        with prepare_output(tmp_path) as output:
            assert output.staging.name.startswith(STAGING_PREFIX)
            (output.staging / "report.json").write_text("new")
            assert (tmp_path / "report.json").read_text() == "old"
            output.commit()
        assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"notes.txt": "mine", "report.json": "new"}

    def test_a_file_in_the_way(self, tmp_path: Path) -> None:
        (tmp_path / "out").write_text("")
        with pytest.raises(OutputError, match="needs a folder"):
            prepare_output(tmp_path / "out")
        with pytest.raises(OutputError, match="cannot be written to"):
            prepare_output(tmp_path / "out" / "deeper")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_unwritable(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(OutputError, match="cannot be written to"):
            prepare_output(tmp_path / "out")

    def test_unwritable_even_for_root(self) -> None:
        with pytest.raises(OutputError, match="cannot be written to"):
            prepare_output(Path("/proc/seamark"))

    def test_report_is_strict_json(self, tmp_path: Path, make_record: MakeRecord) -> None:
        write_results(make_record(), tmp_path, load_config())

        def refuse(text: str) -> None:
            raise AssertionError(text)

        report = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)
        assert report["frames"]["total"] == 62
