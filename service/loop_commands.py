"""The command `seamark map loops`: the loops of a map, and why one of them is what it is."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from seamark.service.map_commands import JsonOption, MapArgument
from seamark.service.terminal import print_json, print_table

ExplainOption = Annotated[str | None, typer.Option("--explain", metavar="ID", help="QUERY-MATCH, as the list has it.")]


def loops_command(
    map_file: MapArgument,
    explain: ExplainOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="With --explain: write the picture there (PNG).")] = None,
    every: Annotated[bool, typer.Option("--all", help="List refused candidates too.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the loops of a map, or explain one: images, matches, tests passed, weight today, history."""
    from seamark.backend.explain import explain as explain_loop
    from seamark.backend.explain import parse_loop_id
    from seamark.backend.map_store import MapStore
    from seamark.service import loop_report
    from seamark.service.config import load_config

    if out is not None and explain is None:
        raise typer.BadParameter("--out belongs to --explain")
    config = load_config(None, os.environ, [])
    with MapStore(map_file, read_only=True) as store:
        loops = store.load_loops()
        if explain is None:
            chosen = [loop for loop in loops if every or loop.accepted or len(store.history(*_key(loop))) > 1]
            shown: Any = [loop_report.loop_as_json(loop, store.history(*_key(loop))) for loop in chosen]
            if as_json:
                print_json(shown)
            else:
                print_table(loop_report.loops_table(map_file, shown, len(loops)))
            return
        found = explain_loop(store, parse_loop_id(explain, loops), config.backend, config.seed)
    if out is not None:
        from seamark.service.loop_picture import draw_explanation

        draw_explanation(found, out)
    if as_json:
        print_json(loop_report.explanation_as_json(found) | ({} if out is None else {"picture": str(out)}))
        return
    for table in loop_report.explanation_tables(found):
        print_table(table)
    if out is not None:
        typer.echo(f"picture: {out}")


def _key(loop: Any) -> tuple[int, int]:
    return loop.query_id, loop.match_id
