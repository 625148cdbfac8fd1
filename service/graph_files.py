"""The files that `seamark graph solve` leaves; their names, columns and number formats are a contract."""

import csv
import json
from pathlib import Path
from typing import Any

from seamark.backend.graph_solve import GraphSolution, LoopVerdict
from seamark.service.output import OutputError, prepare_output
from seamark.service.results import TUM_HEADER, number, pose_fields

GRAPH_LOOP_COLUMNS = ("from", "to", "kept", "reason", "weight", "added_at", "withdrawn_at", "withdrawals")


def write_graph_results(solution: GraphSolution, report: dict[str, Any], out: Path) -> None:
    """Write ``trajectory.tum``, ``loops.csv`` and ``report.json``, all of them or none; raises OutputError."""
    estimate = solution.estimate
    rows = [
        " ".join([str(node), *pose_fields(T)])
        for node, T in zip(estimate.keyframe_ids.tolist(), estimate.T_map_cam, strict=True)
    ]
    with prepare_output(out) as output:
        try:
            text = "\n".join([TUM_HEADER, *rows]) + "\n"
            (output.staging / "trajectory.tum").write_text(text, encoding="utf-8")
            with (output.staging / "loops.csv").open("w", encoding="utf-8", newline="") as stream:
                writer = csv.writer(stream, lineterminator="\n")
                writer.writerow(GRAPH_LOOP_COLUMNS)
                writer.writerows(_loop_row(loop) for loop in solution.loops)
            text = json.dumps(report, indent=2, allow_nan=False)
            (output.staging / "report.json").write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"results cannot be written to {out}: {error.strerror}") from error
        output.commit()


def graph_report(solution: GraphSolution, ignored: dict[str, int], live: bool, cpu_s: float) -> dict[str, Any]:
    """Return the figures of report.json; ``cpu_s``: reading, judging and optimising, without imports and writing."""
    loops = solution.loops
    reasons = sorted({loop.reason for loop in loops})
    return {
        "nodes": len(solution.estimate.keyframe_ids),
        "planar": solution.planar,
        "mode": "live" if live else "batch",
        "parts": solution.parts,
        "components": len(set(solution.estimate.components.tolist())),
        "loops": len(loops),
        "kept": sum(loop.kept for loop in loops),
        "reasons": {reason: sum(loop.reason == reason for loop in loops) for reason in reasons},
        "withdrawals": sum(loop.withdrawals for loop in loops),
        "ignored_lines": ignored,
        "noise_factor_odometry": solution.noise.odometry,
        "noise_factor_loops": solution.noise.loops,
        "solve_cpu_s": round(cpu_s, 4),
        "stages_cpu_s": {stage: round(seconds, 4) for stage, seconds in solution.seconds.items()},
    }


def _loop_row(loop: LoopVerdict) -> list[str]:
    times = ["" if value is None else str(value) for value in (loop.added_at, loop.withdrawn_at)]
    kept = "1" if loop.kept else "0"
    evidence = [kept, loop.reason, number(loop.weight, 6)]
    return [str(loop.from_id), str(loop.to_id), *evidence, *times, str(loop.withdrawals)]
