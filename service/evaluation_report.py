"""`seamark eval`: two trajectory files to errors."""

from pathlib import Path
from typing import Any

from rich.table import Table

from seamark.service.evaluation import Alignment, EvaluationError
from seamark.service.report import compare
from seamark.service.trajectory_files import load_trajectory


def evaluate_files(trajectory: Path, ground_truth: Path, alignment: str) -> dict[str, Any]:
    """Return ATE and RPE of a trajectory file against the truth's; raises SeamarkError."""
    try:
        kind = Alignment(alignment)
    except ValueError as error:
        raise EvaluationError(f"{alignment!r} is not an alignment; there are {', '.join(Alignment)}") from error
    result = compare(load_trajectory(trajectory), load_trajectory(ground_truth), kind)
    if "error" in result:
        raise EvaluationError(f"{trajectory}: {result['error']}")
    return {"trajectory": str(trajectory), "ground_truth": str(ground_truth), **result}


def table(result: dict[str, Any]) -> Table:
    """Return the errors as a table for the terminal."""
    absolute = result["ate"]
    out = Table(title=f"{result['trajectory']} against {result['ground_truth']}")
    for column in ("error", "rmse", "mean", "median", "max"):
        out.add_column(column, justify="left" if column == "error" else "right")

    def row(name: str, figures: dict[str, float], unit: str) -> None:
        out.add_row(name, *(f"{figures[key]:.4f} {unit}" for key in ("rmse", "mean", "median", "max")))

    row(f"ATE, {absolute['alignment']}, {absolute['pairs']} pairs", absolute["translation_m"], "m")
    for relative in result["rpe"]:
        step = relative["delta"]
        row(f"RPE per {step}, translation", relative["translation_m"], "m")
        row(f"RPE per {step}, rotation", relative["rotation_deg"], "deg")
    return out
