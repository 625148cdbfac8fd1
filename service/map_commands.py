"""The commands `seamark map ...`: what is in a map file, whether it is whole, and what to do if it is not."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from seamark.service.terminal import Bar, print_json, print_table

# Everything else is imported in the command that needs it: --help must not wait for OpenCV.

EXIT_DAMAGED = 3

map_app = typer.Typer(no_args_is_help=True, help="Map files: look at them, check, repair, export and prune them.")

NewMapOption = Annotated[Path, typer.Option("--out", help="The new map file to write.")]
MapArgument = Annotated[Path, typer.Argument(help="The map file.")]
OverrideOption = Annotated[list[str] | None, typer.Option("-o", metavar="KEY=VALUE", help="Set section.key=value.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@map_app.command("info")
def info_command(map_file: MapArgument, as_json: JsonOption = False) -> None:
    """Print what is in a map: sessions, keyframes, loops, sizes. A service may be writing it meanwhile."""
    from seamark.backend.map_info import describe_map
    from seamark.service import map_report

    info = describe_map(map_file)
    if as_json:
        print_json(asdict(info))
        return
    for table in map_report.info_tables(map_file, info):
        print_table(table)


@map_app.command("check")
def check_command(map_file: MapArgument, as_json: JsonOption = False) -> None:
    """Read all of a map and verify every checksum and reference. Exit code 3: it is damaged."""
    from seamark.backend.map_check import check_map
    from seamark.service import map_report

    with Bar("checking") as bar:
        report = check_map(map_file, bar.count)
    if as_json:
        print_json({"whole": not report.problems, **asdict(report)})
    else:
        print_table(map_report.check_table(map_file, report))
    if report.problems:
        raise typer.Exit(EXIT_DAMAGED)


@map_app.command("repair")
def repair_command(map_file: MapArgument, out: NewMapOption, as_json: JsonOption = False) -> None:
    """Save all that is whole in a damaged map (or one of an earlier version) to a new file, and say what is lost."""
    from seamark.backend.map_repair import repair_map
    from seamark.service import map_report

    report = repair_map(map_file, out)
    if as_json:
        print_json({"out": str(out), **asdict(report)})
    else:
        print_table(map_report.repair_table(out, report))


@map_app.command("backup")
def backup_command(map_file: MapArgument, out: NewMapOption, as_json: JsonOption = False) -> None:
    """Copy a map as it is at this moment. A service may be writing it meanwhile, and is not held up."""
    from seamark.backend.map_backup import back_up_map

    size = back_up_map(map_file, out)
    if as_json:
        print_json({"out": str(out), "bytes": size})
    else:
        typer.echo(f"{out}: {size} bytes")


@map_app.command("export")
def export_command(
    map_file: MapArgument,
    out: Annotated[Path, typer.Option("--out", help="The file to write; for colmap the folder.")],
    form: Annotated[str, typer.Option("--format", help="tum, kitti, euroc, g2o, colmap or ply.")] = "tum",
    component: Annotated[
        int | None,
        typer.Option("--component", help="Session whose frame of reference is meant; default: the largest."),
    ] = None,
    dense: Annotated[bool, typer.Option("--dense", help="With ply: the surfaces of the depth images.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write the keyframes' poses, the pose graph, a COLMAP model or the points of a map."""
    from seamark.backend.map_export import Format, export_map

    if form not in list(Format):
        raise typer.BadParameter(f"{form!r} is none of {', '.join(Format)}", param_hint="--format")
    if dense and form != Format.PLY:
        raise typer.BadParameter("goes with --format ply", param_hint="--dense")
    written = export_map(map_file, out, Format(form), component, dense=dense)
    if as_json:
        print_json({"out": str(out), "format": form, **written})
    else:
        typer.echo(f"{out}: " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in written.items()))


@map_app.command("prune")
def prune_command(
    map_file: MapArgument,
    keyframes: Annotated[int, typer.Option("--keyframes", min=1, help="Views to keep, as far as places allow.")],
    override: OverrideOption = None,
    as_json: JsonOption = False,
) -> None:
    """Forget redundant views of a map that no service is writing; each place keeps one of each lighting."""
    import os

    from seamark.backend.map_pruning import prune_map
    from seamark.service.config import load_config

    pruning = prune_map(map_file, keyframes, load_config(None, os.environ, override or []).backend)
    if as_json:
        print_json({"forgotten": len(pruning.forget), "kept": pruning.kept, "wanted": pruning.wanted})
    else:
        typer.echo(f"{map_file}: {len(pruning.forget)} views forgotten, {pruning.kept} kept, {keyframes} wanted")
