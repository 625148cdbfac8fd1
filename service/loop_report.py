"""Loops of a map as tables and as plain values."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from seamark.backend.explain import Explanation
from seamark.backend.map_reader import Verdict
from seamark.backend.types import Loop
from seamark.frontend.types import Keyframe
from seamark.service.directions import direction_as_json
from seamark.service.loop_picture import facts_of


def loop_as_json(loop: Loop, history: Sequence[Verdict]) -> dict[str, Any]:
    """Return a loop's row and how often it was withdrawn."""
    withdrawals = sum(a.accepted and not b.accepted for a, b in itertools.pairwise(history))
    return {
        "id": f"{loop.query_id}-{loop.match_id}",
        "query": loop.query_id,
        "match": loop.match_id,
        "accepted": loop.accepted,
        "reason": str(loop.reason),
        "inliers": loop.inliers,
        "score": _number(loop.score),
        "votes": _number(loop.votes),
        "jeffrey": _number(loop.jeffrey),
        "withdrawals": withdrawals,
    }


def loops_table(path: Path, rows: Sequence[dict[str, Any]], total: int) -> Table:
    """Return the list of loops."""
    table = Table(title=f"{path}: {len(rows)} of {total} candidates", title_justify="left")
    for name in ("id", "verdict", "inliers", "score", "votes", "jeffrey", "withdrawals"):
        table.add_column(name, justify="left" if name in ("id", "verdict") else "right")
    for row in rows:
        numbers = ["-" if row[name] is None else f"{row[name]:.3f}" for name in ("score", "votes", "jeffrey")]
        table.add_row(row["id"], row["reason"], str(row["inliers"]), *numbers, str(row["withdrawals"]))
    return table


def explanation_as_json(found: Explanation) -> dict[str, Any]:
    """Return all of an explanation but the images; ``matches`` are x, y in the query, x, y in the match, explained."""
    loop, evidence = found.loop, found.evidence
    out = loop_as_json(loop, found.history) | {
        "query": _keyframe(found.query),
        "match": _keyframe(found.match),
        "evidence": str(found.source),
        "T_match_query": None if loop.T_match_query is None else loop.T_match_query.tolist(),
        "covariance": None if loop.covariance is None else loop.covariance.tolist(),
        "scale": loop.scale,
        "map_error": None if found.error is None else found.error.tolist(),
        "chi2": _number(found.chi2),
        "weight": _number(found.weight),
        "history": [
            {
                "accepted": entry.accepted,
                "reason": str(entry.reason),
                "newest_keyframe": entry.newest_keyframe_id,
                "revision": entry.revision,
            }
            for entry in found.history
        ],
        "gates": [],
        "direction": None,
        "reprojection_px": None,
        "matches": [],
        "missing": [],
    }
    if evidence is not None:
        out["gates"] = [
            {
                "name": gate.name,
                "value": _number(gate.value),
                "limit": gate.limit,
                "must_be": "at least" if gate.least else "at most",
                "passed": gate.passed,
            }
            for gate in evidence.gates
        ]
        if evidence.direction is not None:
            out["direction"] = direction_as_json(evidence.direction)
        out["reprojection_px"] = _number(evidence.reprojection_px)
        pairs = zip(evidence.pixels.tolist(), evidence.inliers.tolist(), strict=True)
        out["matches"] = [[*pixels, inlier] for pixels, inlier in pairs]
        out["missing"] = evidence.missing.tolist()
    return out


def explanation_tables(found: Explanation) -> list[Table]:
    """Return the gates, and everything else."""
    loop = found.loop
    verdict = "accepted" if loop.accepted else f"refused: {loop.reason}"
    title = f"loop {loop.query_id}-{loop.match_id}: {verdict}"
    gates = Table("gate", "value", "limit", "", title=title, title_justify="left")
    for gate in found.evidence.gates if found.evidence is not None else ():
        relation = "at least" if gate.least else "at most"
        gates.add_row(
            gate.name, f"{gate.value:.4g}", f"{relation} {gate.limit:.4g}", "passed" if gate.passed else "failed"
        )
    rest = Table(show_header=False)
    for keyframe, role in ((found.query, "query"), (found.match, "match")):
        rest.add_row(role, f"keyframe {keyframe.id}, session {keyframe.session}, {keyframe.file}")
    for name, value in facts_of(found):
        rest.add_row(name, value)
    return [gates, rest]


def _keyframe(keyframe: Keyframe) -> dict[str, Any]:
    return {
        "keyframe": keyframe.id,
        "session": keyframe.session,
        "frame": keyframe.index,
        "stamp_ns": keyframe.stamp_ns,
        "file": keyframe.file,
    }


def _number(value: float | None) -> float | None:
    """Return a number that JSON knows."""
    return None if value is None or not np.isfinite(value) else float(value)
