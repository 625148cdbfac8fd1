"""What a full optimisation of a map has brought, as plain values and as a table."""

from pathlib import Path
from typing import Any

from rich.table import Table

from seamark.backend.map_optimise import Optimised
from seamark.service.evaluation import Alignment, EvaluationError, ate, load_trajectory
from seamark.service.types import Trajectory


def as_json(done: Optimised, truth: Path | None) -> dict[str, Any]:
    """Return one entry per component; errors against ``truth`` (SE(3) alignment) where it is given."""
    true = None if truth is None else load_trajectory(truth)
    components = []
    for component, adjusted in done.components.items():
        mine = done.component_of == component
        entry: dict[str, Any] = {
            "component": component,
            "keyframes": int(mine.sum()),
            "landmarks": adjusted.landmarks,
            "observations": adjusted.observations,
            "dropped": adjusted.dropped,
            "iterations": adjusted.iterations,
            "median_px": list(adjusted.median_px),
            "rms_px": list(adjusted.rms_px),
            "better": adjusted.better,
        }
        if true is not None:
            stamps = done.stamps_ns[mine]
            both = [Trajectory(stamps, T[mine]) for T in (done.before, done.after)]
            entry["ate_m"] = [_ate(trajectory, true) for trajectory in both]
        components.append(entry)
    return {"revision": done.revision, "components": components}


def table(path: Path, report: dict[str, Any]) -> Table:
    """Return the report for people."""
    written = "nothing written" if report["revision"] is None else f"revision {report['revision']} written"
    out = Table(title=f"{path}: {written}", title_justify="left")
    for name in ("component", "keyframes", "landmarks", "observations", "dropped", "rms px", "ATE m", "verdict"):
        out.add_column(name, justify="right")
    for entry in report["components"]:
        errors = entry.get("ate_m")
        numbers = (entry[name] for name in ("component", "keyframes", "landmarks", "observations", "dropped"))
        change = "{:.3f} to {:.3f}".format(*entry["rms_px"])
        error = "-" if errors is None or None in errors else "{:.4f} to {:.4f}".format(*errors)
        out.add_row(*map(str, numbers), change, error, "better" if entry["better"] else "old poses kept")
    return out


def _ate(trajectory: Trajectory, truth: Trajectory) -> float | None:
    try:
        return ate(trajectory, truth, Alignment.SE3).translation_m.rmse
    except EvaluationError:
        return None
