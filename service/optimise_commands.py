"""The command `seamark map optimise`: everything that a map has seen, adjusted together, on demand."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from seamark.service.map_commands import JsonOption, MapArgument
from seamark.service.terminal import print_json, print_table


def optimise_command(
    map_file: MapArgument,
    full: Annotated[bool, typer.Option("--full", help="Bundle adjustment: poses and landmarks together.")] = False,
    truth: Annotated[Path | None, typer.Option("--truth", help="TUM file with true poses: say the error too.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Optimise a map that no service has open. Old poses stay where new ones do not explain more of what was seen."""
    if not full:
        raise typer.BadParameter("only --full can be asked for: a service keeps the pose graph optimised by itself")
    from seamark.backend.map_optimise import optimise_map
    from seamark.service import optimise_report
    from seamark.service.config import load_config

    done = optimise_map(map_file, load_config(None, os.environ, []).backend)
    report: dict[str, Any] = optimise_report.as_json(done, truth)
    if as_json:
        print_json(report)
    else:
        print_table(optimise_report.table(map_file, report))
