"""The command `seamark map covariances`: how sure a map is of its newest poses."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from seamark.service.map_commands import JsonOption, MapArgument
from seamark.service.terminal import print_json, print_table


def covariances_command(
    map_file: MapArgument,
    last: Annotated[int, typer.Option("--last", min=1, help="How many of the newest keyframes.")] = 20,
    as_json: JsonOption = False,
) -> None:
    """Print the standard deviations of a map's newest poses, relative to the first keyframe of their component.

    With --json also the covariances (6 x 6) in the keyframe's frame, rotation first. A service may be writing the map.
    """
    from seamark.backend.map_covariances import pose_covariances
    from seamark.service.config import load_config

    found = pose_covariances(map_file, last, load_config(None, os.environ, []).backend)
    sigmas = found.sigmas().tolist()
    columns = (found.keyframe_ids.tolist(), found.stamps_ns.tolist(), found.components.tolist())
    rows = list(zip(*columns, sigmas, found.covariances.tolist(), strict=True))
    if as_json:
        names = ("keyframe", "stamp_ns", "component", "sigma", "covariance")
        print_json({"poses": [dict(zip(names, row, strict=True)) for row in rows]})
        return
    print_table(_table(map_file, [(row[0], row[2], *row[3]) for row in rows]))


def _table(path: Path, rows: list[tuple[int, int, float, float]]) -> Table:
    out = Table(title=f"{path}: standard deviations of the newest poses", title_justify="left")
    for name in ("keyframe", "component", "degrees", "m"):
        out.add_column(name, justify="right")
    for number, component, degrees, metres in rows:
        out.add_row(str(number), str(component), f"{degrees:.3f}", f"{metres:.4f}")
    return out
