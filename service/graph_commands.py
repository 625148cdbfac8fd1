"""The commands `seamark graph ...`: pose graphs on their own."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from seamark.service.terminal import print_json, print_table

graph_app = typer.Typer(no_args_is_help=True, help="Pose graphs from files.")


@graph_app.callback()
def _graph() -> None:
    """Keep `solve` a command of its own while it is the only one."""


@graph_app.command("solve")
def solve_command(
    file: Annotated[Path, typer.Argument(help="Pose graph in g2o format, SE2 or SE3, with or without vertices.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")],
    live: Annotated[
        bool, typer.Option("--live", help="Feed the edges in the order of their later node, as a robot meets them.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Decide which loops of a pose graph to believe, as the live service does, and where its nodes are."""
    from seamark.backend.g2o import read_g2o
    from seamark.backend.graph_solve import solve_graph
    from seamark.service.graph_files import graph_report, write_graph_results

    started = time.process_time()
    graph = read_g2o(file)
    solution = solve_graph(graph, live)
    report = graph_report(solution, graph.ignored, live, time.process_time() - started)
    write_graph_results(solution, report, out)
    if as_json:
        print_json(report)
        return
    table = Table("figure", "value", title=str(file))
    for name, value in report.items():
        table.add_row(name, str(value))
    print_table(table)
