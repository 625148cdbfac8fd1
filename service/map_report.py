"""Tables of what the commands `seamark map ...` have found."""

from pathlib import Path

from rich.table import Table

from seamark.backend.map_check import CheckReport
from seamark.backend.map_info import MapInfo
from seamark.backend.map_repair import RepairReport

MOST_LINES = 30


def info_tables(path: Path, info: MapInfo) -> list[Table]:
    """Return the map as a whole, then its sessions."""
    whole = _pairs(str(path))
    whole.add_row("version", str(info.version))
    whole.add_row("size", f"{info.file_bytes / 1e6:.1f} MB, {info.used_bytes / 1e6:.1f} MB of it used")
    keyframes = info.rows["keyframes"]
    whole.add_row("keyframes", f"{keyframes}, {info.recognisable} of them with features")
    whole.add_row("loops", f"{info.accepted_loops} of {info.rows['loops']}, {info.withdrawn_loops} withdrawn")
    if info.adjusted:
        whole.add_row("adjusted", f"{info.adjusted} keyframes by a full adjustment that stands")
    for reason, count in info.reasons.items():
        whole.add_row(f"  {reason}", str(count))
    for name, size in info.bytes_of.items():
        per_keyframe = size / 1e3 / max(1, info.recognisable)
        whole.add_row(name.replace("_", " "), f"{size / 1e6:.1f} MB, {per_keyframe:.1f} kB per keyframe")
    for key, value in info.meta.items():
        whole.add_row(key, value)
    sessions = Table("session", "joined to", "keyframes", "first keyframe", "first stamp in s", title="sessions")
    for one in info.sessions:
        joined = "-" if one["component"] == one["id"] else str(one["component"])
        numbers = (one["id"], joined, one["keyframes"], one["first_keyframe"], f"{1e-9 * one['stamp_ns']:.3f}")
        sessions.add_row(*map(str, numbers))
    return [whole, sessions]


def check_table(path: Path, report: CheckReport) -> Table:
    """Return the verdict and the first problems."""
    table = _pairs(str(path))
    table.add_row("verdict", "damaged" if report.problems else "whole")
    table.add_row("rows read", str(sum(report.rows.values())))
    return _with_lines(table, {"problem": list(report.problems)})


def repair_table(out: Path, report: RepairReport) -> Table:
    """Return what was saved, lost and mended."""
    table = _pairs(str(out))
    for name, count in report.saved.items():
        if count:
            table.add_row(name, str(count))
    return _with_lines(table, {"damaged": report.damaged, "lost": report.lost, "mended": report.mended})


def _pairs(title: str) -> Table:
    return Table(show_header=False, title=title, title_justify="left")


def _with_lines(table: Table, lines: dict[str, list[str]]) -> Table:
    for name, texts in lines.items():
        for text in texts[:MOST_LINES]:
            table.add_row(name, text)
        if len(texts) > MOST_LINES:
            table.add_row(name, f"... {len(texts) - MOST_LINES} more")
    return table
