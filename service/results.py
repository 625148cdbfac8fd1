"""The files that a run leaves: their names, columns and number formats are a contract (columns may be added)."""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from seamark.backend.types import Loop
from seamark.frontend import se3
from seamark.frontend.types import Matrix, Odometry
from seamark.service import trajectories
from seamark.service.config import SeamarkConfig, dump_yaml
from seamark.service.output import Output, OutputError, prepare_output
from seamark.service.picture import draw_run
from seamark.service.report import build_report
from seamark.service.stamps import format_stamp
from seamark.service.types import KeyframeSummary, RunRecord, Trajectory

__all__ = ["FRAME_COLUMNS", "LOOP_COLUMNS", "TUM_HEADER", "Output", "OutputError", "prepare_output", "write_results"]

TUM_HEADER = "# stamp tx ty tz qx qy qz qw"
FRAME_COLUMNS = (
    *("stamp", "file", "session", "quality", "inliers", "reprojection_px", "latency_ms", "outcome"),
    *("loss", "near_share"),
)
LOOP_COLUMNS = (
    *("query_stamp", "match_stamp", "query_file", "match_file", "accepted", "reason"),
    *("score", "votes", "jeffrey", "inliers", "tx", "ty", "tz", "qx", "qy", "qz", "qw"),
)


def write_results(record: RunRecord, out: Path, config: SeamarkConfig) -> None:
    """Write all files of a run into the folder, all of them or none; raises OutputError.

    The recording and the map, which grow while the run goes on, are not written here: a runner makes an Output first,
    lets them grow in its staging folder, calls write_files with that folder and commits.
    """
    with prepare_output(out) as output:
        write_files(record, output.staging, config)
        output.commit()


def write_files(record: RunRecord, folder: Path, config: SeamarkConfig) -> None:
    """Write trajectories, tables, report, configuration and picture; raises OutputError when the disk refuses.

    ``trajectory.tum`` and ``keyframes.tum`` hold T_map_cam of the main component, ``odometry.tum`` T_odom_cam of all
    sessions. A ``session`` of -1 means none. Wall times are left empty when the record is deterministic.
    """
    report = build_report(record, config)
    try:
        (folder / "trajectory.tum").write_text(tum_text(trajectories.corrected(record)), encoding="utf-8")
        (folder / "odometry.tum").write_text(tum_text(trajectories.as_given(record)), encoding="utf-8")
        (folder / "keyframes.tum").write_text(tum_text(trajectories.keyframes(record)), encoding="utf-8")
        rows = (frame_row(frame, timed=not record.deterministic) for frame in record.odometry)
        _write_csv(folder / "frames.csv", FRAME_COLUMNS, rows)
        by_id = {keyframe.id: keyframe for keyframe in (*record.known, *record.keyframes)}
        _write_csv(folder / "loops.csv", LOOP_COLUMNS, (loop_row(loop, by_id) for loop in record.snapshot.loops))
        (folder / "config.yaml").write_text(dump_yaml(config), encoding="utf-8")
        text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
        (folder / "report.json").write_text(text + "\n", encoding="utf-8")
        draw_run(record, report, folder / "trajectory.png")
    except OSError as error:
        raise OutputError(f"results cannot be written to {folder}: {error.strerror}") from error


def tum_text(trajectory: Trajectory) -> str:
    """Return ``stamp tx ty tz qx qy qz qw`` rows under a header line."""
    rows = (
        " ".join([format_stamp(int(stamp)), *pose_fields(T)])
        for stamp, T in zip(trajectory.stamps_ns, trajectory.T_world_cam, strict=True)
    )
    return "\n".join([TUM_HEADER, *rows]) + "\n"


def pose_fields(T: Matrix | None) -> list[str]:
    """Return tx ty tz qx qy qz qw with nine significant digits, or seven empty fields for an unknown pose."""
    if T is None or not np.isfinite(T).all():
        return [""] * 7
    return [number(value, 9) for value in (*T[:3, 3], *se3.to_quaternion(T[:3, :3]))]


def number(value: float, digits: int) -> str:
    """Return a number with so many significant digits; not-a-number and infinity are empty, minus zero is zero."""
    return f"{value + 0.0:.{digits}g}" if math.isfinite(value) else ""


def frame_row(frame: Odometry, *, timed: bool = True) -> list[str]:
    """Return one row of frames.csv."""
    return [
        format_stamp(frame.stamp_ns),
        frame.file,
        str(frame.session),
        frame.quality.value,
        str(frame.inliers),
        number(frame.reprojection_px, 6),
        number(frame.latency_ms, 6) if timed else "",
        frame.outcome.value,
        "" if frame.loss is None else frame.loss.value,
        "" if frame.near_share is None else number(frame.near_share, 3),
    ]


def loop_row(loop: Loop, keyframes: dict[int, KeyframeSummary]) -> list[str]:
    """Return one row of loops.csv; stamps and files are empty for keyframes that are not of this run."""
    query, match = keyframes.get(loop.query_id), keyframes.get(loop.match_id)
    return [
        format_stamp(query.stamp_ns) if query else "",
        format_stamp(match.stamp_ns) if match else "",
        query.file if query else "",
        match.file if match else "",
        "1" if loop.accepted else "0",
        loop.reason.value,
        number(loop.score, 9),
        number(loop.votes, 9),
        number(loop.jeffrey, 9),
        str(loop.inliers),
        *pose_fields(loop.T_match_query),
    ]


def _write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
