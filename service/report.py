"""The figures of one run: as a dictionary for report.json, as a table for the terminal."""

import dataclasses
import platform
from collections.abc import Iterable, Sequence
from importlib import metadata
from typing import Any

import numpy as np
from rich.table import Table

import seamark
from seamark.backend.types import Reason
from seamark.frontend.types import Mode, Odometry, Outcome
from seamark.service import trajectories
from seamark.service.config import SeamarkConfig, config_hash
from seamark.service.evaluation import AbsoluteError, Alignment, EvaluationError, RelativeError, ate, path_length, rpe
from seamark.service.stamps import NANOSECONDS, format_stamp
from seamark.service.types import RunRecord, Trajectory

PACKAGES = ("numpy", "opencv-contrib-python-headless", "gtsam", "faiss-cpu", "eclipse-zenoh", "rerun-sdk", "protobuf")
# Segments are measured where the path is at least twice as long.
SEGMENTS_M = (1.0, 10.0, 100.0)
SIGNIFICANT_DIGITS = 6
# A frame without a pose for one of these reasons is not lost: there was none to be had yet, or ever.
NOT_LOST = frozenset({Outcome.INITIALISING, Outcome.PLACE})


def build_report(record: RunRecord, config: SeamarkConfig) -> dict[str, Any]:
    """Return everything that report.json says; not-a-number and infinity become None."""
    corrected = trajectories.corrected(record)
    report = {
        "sources": list(record.sources),
        "mode": record.mode.value,
        "frames": {
            "total": len(record.odometry),
            "tracked": trajectories.tracked(record),
            "in_trajectory": len(corrected),
            "by_outcome": _counts(frame.outcome.value for frame in record.odometry),
            "by_quality": _counts(frame.quality.value for frame in record.odometry),
            "by_loss": _counts(frame.loss.value for frame in record.odometry if frame.loss is not None),
        },
        "duration_s": _duration_s(record.odometry),
        "lost_spans": lost_spans(record.odometry),
        "sessions": _sessions(record),
        "keyframes": len(record.keyframes),
        "loops": _loops(record),
        "latency_ms": _latencies(record),
        "wall_s": record.wall_s,
        "frames_per_second": len(record.odometry) / record.wall_s if record.wall_s > 0 else None,
        "processes": [dataclasses.asdict(process) for process in record.processes],
        "path_length_m": path_length(corrected),
        "accuracy": accuracy(record),
        "map_revision": record.snapshot.revision,
        "seed": config.seed,
        "deterministic": record.deterministic,
        "versions": versions(),
        "config_hash": config_hash(config),
    }
    plain: dict[str, Any] = _plain(report)
    return plain


def accuracy(record: RunRecord) -> dict[str, Any] | None:
    """Return ATE and RPE of odometry (its longest session) and corrected trajectory; None without ground truth.

    Aligned by a rigid motion where the scale is known, by a similarity for mono.
    """
    truth = record.ground_truth
    if truth is None or record.mode is Mode.PLACES:
        return None
    alignment = Alignment.SIM3 if record.mode is Mode.MONO else Alignment.SE3
    session = trajectories.main_session(record.odometry)
    return {
        "alignment": alignment.value,
        "ground_truth_length_m": path_length(_during(truth, record.odometry)),
        "odometry": {"session": session, **compare(trajectories.as_given(record, session), truth, alignment)},
        "corrected": compare(trajectories.corrected(record), truth, alignment),
    }


def compare(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> dict[str, Any]:
    """Return ``ate`` and a list ``rpe`` (per frame, then per segment where the way is long enough), or ``error``."""
    if len(estimate) == 0:
        return {"error": "no frame has a pose"}
    try:
        absolute: AbsoluteError = ate(estimate, truth, alignment)
    except EvaluationError as error:
        return {"error": str(error)}
    segments = [None, *(m for m in SEGMENTS_M if 2 * m <= absolute.length_m)]
    relative = [_relative(estimate, truth, alignment, segment) for segment in segments]
    return {
        "ate": dataclasses.asdict(absolute),
        "rpe": [dataclasses.asdict(one) for one in relative if one is not None],
    }


def lost_spans(odometry: Sequence[Odometry]) -> list[dict[str, Any]]:
    """Return the runs of frames without a pose: stamps of first and last frame, their number, what happened, why, and
    the outcome of the frame that ended it (None: the end of the run).
    """
    spans: list[tuple[list[Odometry], str | None]] = []
    span: list[Odometry] = []
    for frame in odometry:
        if frame.T_odom_cam is None and frame.outcome not in NOT_LOST:
            span.append(frame)
        elif span:
            spans.append((span, frame.outcome.value))
            span = []
    if span:
        spans.append((span, None))
    return [
        {
            "from": format_stamp(span[0].stamp_ns),
            "to": format_stamp(span[-1].stamp_ns),
            "frames": len(span),
            "by_outcome": _counts(frame.outcome.value for frame in span),
            "by_loss": _counts(frame.loss.value for frame in span if frame.loss is not None),
            "ended_by": ended_by,
        }
        for span, ended_by in spans
    ]


def percentiles(values: Sequence[float]) -> dict[str, Any]:
    """Return count, p50, p95, p99 and the maximum of latencies, NaN left out."""
    finite = np.array([value for value in values if np.isfinite(value)])
    if len(finite) == 0:
        return {"count": 0, "p50": None, "p95": None, "p99": None, "max": None}
    p50, p95, p99 = np.percentile(finite, [50, 95, 99])
    return {"count": len(finite), "p50": p50, "p95": p95, "p99": p99, "max": finite.max()}


def versions() -> dict[str, str]:
    """Return the versions of what the figures depend on."""
    found = {"seamark": seamark.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def report_table(report: dict[str, Any]) -> Table:
    """Return the figures that matter as one table for the terminal."""
    table = Table(title=f"seamark run, {report['mode']}", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    frames, loops = report["frames"], report["loops"]
    table.add_row("sources", "\n".join(report["sources"]))
    table.add_row("frames", _frames_text(frames, report["mode"]))
    if report["lost_spans"]:
        table.add_row(
            "lost", f"{sum(s['frames'] for s in report['lost_spans'])} frames in {len(report['lost_spans'])} spans"
        )
    table.add_row("sessions, keyframes", f"{len(report['sessions'])}, {report['keyframes']}")
    rejected = ", ".join(f"{reason} {count}" for reason, count in loops["rejected_by_reason"].items())
    counts = f"{loops['accepted']} accepted, {loops['rejected']} rejected"
    table.add_row("loops", f"{counts} ({rejected})" if rejected else counts)
    for row in _accuracy_rows(report["accuracy"]):
        table.add_row(*row)
    latency = report["latency_ms"].get("frame", {})
    if latency.get("count"):
        text = "  ".join(f"{name} {latency[name]:.1f}" for name in ("p50", "p95", "p99"))
        table.add_row("frame latency", f"{text} ms")
    if report["frames_per_second"]:
        table.add_row("speed", f"{report['frames_per_second']:.1f} frames/s, {report['wall_s']:.1f} s")
    for process in report["processes"]:
        text = f"{process['peak_rss_bytes'] / 2**20:.0f} MiB peak, {process['cpu_s']:.1f} s CPU"
        table.add_row(f"process {process['name']}", text)
    return table


def _frames_text(frames: dict[str, Any], mode: str) -> str:
    others = {k: v for k, v in frames["by_outcome"].items() if k not in (Outcome.TRACKED, Outcome.PLACE)}
    detail = f" ({', '.join(f'{name} {count}' for name, count in others.items())})" if others else ""
    if mode == Mode.PLACES:
        return f"{frames['total']}{detail}"
    apart = frames["tracked"] - frames["in_trajectory"]
    elsewhere = f", {apart} of them apart from the trajectory" if apart else ""
    return f"{frames['tracked']} of {frames['total']} with a pose{elsewhere}{detail}"


def _accuracy_rows(figures: dict[str, Any] | None) -> Iterable[tuple[str, str]]:
    if figures is None:
        return
    for key in ("odometry", "corrected"):
        part = figures[key]
        if "error" in part:
            yield f"{key}", part["error"]
            continue
        error, frame = part["ate"], part["rpe"][0] if part["rpe"] else None
        text = f"ATE {error['translation_m']['rmse']:.4f} m over {error['length_m']:.1f} m ({figures['alignment']})"
        if frame is not None:
            millimetres, degrees = frame["translation_m"]["rmse"] * 1000, frame["rotation_deg"]["rmse"]
            text += f", RPE {millimetres:.1f} mm {degrees:.3f} deg per frame"
        yield key, text


def _relative(
    estimate: Trajectory, truth: Trajectory, alignment: Alignment, segment_m: float | None
) -> RelativeError | None:
    try:
        return rpe(estimate, truth, alignment, segment_m)
    except EvaluationError:
        return None


def _sessions(record: RunRecord) -> list[dict[str, Any]]:
    snapshot = record.snapshot
    components = {int(s): int(c) for s, c in zip(snapshot.sessions, snapshot.components, strict=True)}
    ids = sorted({frame.session for frame in record.odometry if frame.session >= 0} | set(components))
    main = trajectories.main_component(record)
    return [
        {
            "id": session,
            "frames": sum(frame.session == session for frame in record.odometry),
            "keyframes": sum(keyframe.session == session for keyframe in record.keyframes),
            "component": components.get(session),
            "in_trajectory": main is not None and components.get(session) == main,
        }
        for session in ids
    ]


def _loops(record: RunRecord) -> dict[str, Any]:
    rejected = [loop for loop in record.snapshot.loops if not loop.accepted]
    counts = _counts(loop.reason.value for loop in rejected)
    return {
        "accepted": len(record.snapshot.loops) - len(rejected),
        "rejected": len(rejected),
        "rejected_by_reason": {reason.value: counts[reason.value] for reason in Reason if reason.value in counts},
    }


def _latencies(record: RunRecord) -> dict[str, Any]:
    stages = {"frame": [frame.latency_ms for frame in record.odometry]}
    for frame in record.odometry:
        for stage, milliseconds in frame.stages_ms.items():
            stages.setdefault(stage, []).append(milliseconds)
    # What the runner collected is complete for its stage, so it takes the place of what the frames say.
    stages |= record.stages_ms
    return {stage: percentiles(values) for stage, values in stages.items()}


def _during(truth: Trajectory, odometry: Sequence[Odometry]) -> Trajectory:
    stamps = [frame.stamp_ns for frame in odometry]
    if not stamps:
        return truth
    inside = (truth.stamps_ns >= min(stamps)) & (truth.stamps_ns <= max(stamps))
    return Trajectory(truth.stamps_ns[inside], truth.T_world_cam[inside])


def _duration_s(odometry: Sequence[Odometry]) -> float:
    stamps = [frame.stamp_ns for frame in odometry]
    return (max(stamps) - min(stamps)) / NANOSECONDS if stamps else 0.0


def _counts(values: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for value in values:
        counts[value] = counts.get(value, 0) + 1
    return dict(sorted(counts.items()))


def _plain(value: Any) -> Any:
    """Make a value fit for JSON: plain numbers of six digits, None instead of not-a-number and infinity."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}") if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
