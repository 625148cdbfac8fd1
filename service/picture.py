"""One picture of a run: the map from above, or the matrix of matches in mode places."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from seamark.frontend.types import Mode
from seamark.service import trajectories
from seamark.service.evaluation import Alignment, EvaluationError, align, pair
from seamark.service.types import RunRecord, Trajectory

INK = "#1f2933"
GREY = "#9aa5b1"
TRUTH = "#52606d"
ODOMETRY = "#e8833a"
CORRECTED = "#1f6feb"
ACCEPTED = "#16a34a"
REJECTED = "#b6bec7"
DPI = 140
WIDTH_IN = 9.0
HEIGHT_RANGE_IN = (5.0, 9.5)
MARGIN = 0.06
# A step longer than this many usual ones is a gap in the path, where nothing is drawn.
GAP_FACTOR = 20.0


@dataclass(frozen=True, eq=False)
class _Paths:
    """What is drawn, as seen from above: lists of (N, 2) positions, loops as (L, 2, 2) segments."""

    truth: NDArray[np.float64]
    odometry: list[NDArray[np.float64]]
    corrected: NDArray[np.float64]
    loops: NDArray[np.float64]
    metric: bool

    def all_points(self) -> NDArray[np.float64]:
        """Return every position that must fit into the picture."""
        return np.concatenate([self.truth, *self.odometry, self.corrected])


def draw_run(record: RunRecord, report: dict[str, Any], path: Path) -> None:
    """Draw the run as PNG: ground truth, odometry, corrected trajectory and loops from above (x forward, y left).

    Ground truth is laid onto the estimate. Where mono meets ground truth, the estimate is drawn in the truth's scale.
    In mode places it shows which query matched which place. ``report`` is what build_report made of the record.
    """
    figure = _draw_matches(record, report) if record.mode is Mode.PLACES else _draw_map(record, report)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png", dpi=DPI, facecolor="white", metadata={"Software": "Seamark"})


def _draw_map(record: RunRecord, report: dict[str, Any]) -> Figure:
    paths = _paths(record)
    points = paths.all_points()
    figure, axes = _canvas(_height(points))
    if len(points) == 0:
        axes.text(0.5, 0.5, "no frame has a pose", ha="center", va="center", color=INK, transform=axes.transAxes)
        axes.set_axis_off()
        _title(axes, record, _map_subtitle(report))
        return figure
    if len(paths.truth):
        axes.plot(*_broken(paths.truth).T, color=TRUTH, lw=4.5, alpha=0.28, label="ground truth")
    axes.plot(*_broken(paths.corrected).T, color=CORRECTED, lw=2.2, label="corrected", solid_capstyle="round")
    for k, one in enumerate(paths.odometry):
        axes.plot(*_broken(one).T, color=ODOMETRY, lw=1.3, ls=(0, (5, 2)), label="odometry" if k == 0 else None)
    if len(paths.loops):
        label = f"loops ({len(paths.loops)})"
        axes.add_collection(LineCollection(list(paths.loops), colors=ACCEPTED, linewidths=1.1, alpha=0.75, zorder=3))
        axes.plot(*paths.loops.reshape(-1, 2).T, ls="", marker="o", ms=4.0, color=ACCEPTED, label=label, zorder=4)
    axes.plot(*paths.corrected[0], ls="", marker="o", ms=8, mfc="white", mec=INK, mew=1.6, label="start", zorder=5)
    axes.plot(*paths.corrected[-1], ls="", marker="s", ms=7, mfc=INK, mec="white", mew=1.0, label="end", zorder=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN)
    unit = "m" if paths.metric else "in units of the map"
    axes.set_xlabel(f"x, forward from the first camera ({unit})")
    axes.set_ylabel(f"y, left ({unit})")
    _title(axes, record, _map_subtitle(report))
    _legend(figure, axes)
    return figure


def _draw_matches(record: RunRecord, report: dict[str, Any]) -> Figure:
    figure, axes = _canvas(8.2)
    index = {keyframe.id: keyframe.index for keyframe in record.keyframes}
    known = [loop for loop in record.snapshot.loops if loop.query_id in index and loop.match_id in index]
    total = max(len(record.odometry), 1)
    axes.plot([0, total], [0, total], color=GREY, lw=0.8)
    for accepted, colour, size, label in ((False, REJECTED, 7.0, "rejected"), (True, ACCEPTED, 14.0, "accepted")):
        chosen = [loop for loop in known if loop.accepted is accepted]
        axes.scatter(
            [index[loop.query_id] for loop in chosen],
            [index[loop.match_id] for loop in chosen],
            s=size,
            color=colour,
            label=f"{label} ({len(chosen)})",
            linewidths=0,
        )
    border = 0.02 * total
    axes.set_xlim(-border, total + border)
    axes.set_ylim(-border, total + border)
    axes.set_aspect("equal")
    axes.set_xlabel("image that asks (running index)")
    axes.set_ylabel("place that was found (running index)")
    loops = report["loops"]
    found = f"{loops['accepted']} places recognised, {loops['rejected']} candidates rejected"
    _title(axes, record, f"{total} images   ·   {found}")
    _legend(figure, axes)
    return figure


def _paths(record: RunRecord) -> _Paths:
    corrected = trajectories.corrected(record)
    scale, truth = _truth_on_estimate(record, corrected)
    places = {
        id_: reference.T_map_cam[:2, 3] * scale
        for id_, reference in trajectories.references(record.snapshot).items()
        if reference.component == trajectories.main_component(record)
    }
    loops = [
        (places[loop.query_id], places[loop.match_id])
        for loop in record.snapshot.loops
        if loop.accepted and loop.query_id in places and loop.match_id in places
    ]
    return _Paths(
        truth=truth,
        odometry=[one.T_world_cam[:, :2, 3] * scale for one in trajectories.odometry_in_map(record)],
        corrected=corrected.T_world_cam[:, :2, 3] * scale,
        loops=np.array(loops, np.float64).reshape(-1, 2, 2),
        metric=record.mode is not Mode.MONO or len(truth) > 0,
    )


def _truth_on_estimate(record: RunRecord, corrected: Trajectory) -> tuple[float, NDArray[np.float64]]:
    """Return the factor that brings the estimate to metres, and the ground truth (N, 2) during the run over it."""
    nothing = 1.0, np.zeros((0, 2))
    truth = record.ground_truth
    if truth is None or len(corrected) == 0:
        return nothing
    kind = Alignment.SIM3 if record.mode is Mode.MONO else Alignment.SE3
    try:
        estimate_part, truth_part = pair(corrected, truth)
        similarity = align(estimate_part.T_world_cam[:, :3, 3], truth_part.T_world_cam[:, :3, 3], kind)
    except EvaluationError:
        return nothing
    stamps = [frame.stamp_ns for frame in record.odometry]
    inside = (truth.stamps_ns >= min(stamps)) & (truth.stamps_ns <= max(stamps))
    moved = similarity.inverse().apply(Trajectory(truth.stamps_ns[inside], truth.T_world_cam[inside]))
    return similarity.scale, moved.T_world_cam[:, :2, 3] * similarity.scale


def _broken(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put NaN rows where the path jumps, so that no line is drawn across a gap in which nothing is known."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    moving = steps[steps > 0]
    if len(moving) == 0:
        return points
    return np.insert(points, np.flatnonzero(steps > GAP_FACTOR * np.median(moving)) + 1, np.nan, axis=0)


def _canvas(height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.12))
    axes = figure.add_subplot()
    axes.grid(color="#e4e7eb", lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=9)
    return figure, axes


def _height(points: NDArray[np.float64]) -> float:
    if len(points) == 0:
        return HEIGHT_RANGE_IN[0]
    width, height = np.maximum(np.nanmax(points, axis=0) - np.nanmin(points, axis=0), 1e-6)
    # About 1.6 inches go to title, labels and legend.
    return float(np.clip(WIDTH_IN * height / width + 1.6, *HEIGHT_RANGE_IN))


def _title(axes: Axes, record: RunRecord, subtitle: str) -> None:
    names = ", ".join(Path(source).name or source for source in record.sources)
    axes.set_title(names, loc="left", fontsize=13, fontweight="bold", color=INK, pad=28)
    axes.annotate(subtitle, (0, 1), (0, 10), "axes fraction", "offset points", fontsize=10, color=TRUTH, va="bottom")


def _map_subtitle(report: dict[str, Any]) -> str:
    frames, figures = report["frames"], report["accuracy"]
    parts = [report["mode"], f"{frames['in_trajectory']} of {frames['total']} frames"]
    if figures is None or figures["alignment"] != Alignment.SIM3:
        parts.append(f"{report['path_length_m']:.1f} m")
    else:
        parts.append(f"{figures['ground_truth_length_m']:.1f} m")
    if figures is not None:
        before, after = (_rmse(figures[key]) for key in ("odometry", "corrected"))
        parts.append(f"ATE {before} before, {after} after loop closing")
    return "   ·   ".join(parts)


def _rmse(part: dict[str, Any]) -> str:
    return "unknown" if "error" in part else f"{part['ate']['translation_m']['rmse']:.3f} m"


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=9.5, labelcolor=INK)
