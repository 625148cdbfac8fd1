"""The commands `seamark synth ...`: synthetic worlds with ground truth."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from seamark.service.terminal import Bar, print_json, print_table

# The rest is imported in the command that needs it: --help must not wait for OpenCV.

synth_app = typer.Typer(no_args_is_help=True, help="Synthetic worlds with ground truth.")

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@synth_app.command("list")
def synth_list_command(as_json: JsonOption = False) -> None:
    """Print the worlds, what can be set, and the ready-made scenarios."""
    from seamark.service import synth

    content = synth.catalogue()
    if as_json:
        print_json(content)
        return
    for table in synth.tables(content):
        print_table(table)


@synth_app.command("render")
def synth_render_command(
    world: Annotated[str, typer.Argument(help="A world or scenario, with settings: NAME[,key=value...].")],
    out: Annotated[Path, typer.Option("--out", help="Folder to make; an interrupted rendering goes on there.")],
    trajectory: Annotated[str | None, typer.Option("--trajectory", help="How the camera moves.")] = None,
    sensors: Annotated[str | None, typer.Option("--sensors", help="rgbd, stereo or mono.")] = None,
    condition: Annotated[str | None, typer.Option("--condition", help="Light, such as day or night.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the world and all errors (default 0).")] = None,
    frames: Annotated[int | None, typer.Option("--frames", help="Number of frames.")] = None,
    layout: Annotated[str, typer.Option("--layout", help="tum, euroc or kitti.")] = "tum",
    as_json: JsonOption = False,
) -> None:
    """Write a synthetic sequence with its ground truth and motion sensors to a folder."""
    from seamark.service import synth

    options = synth.RenderOptions(world, trajectory, sensors, condition, seed, frames)
    with Bar(f"synth {world}") as bar:
        written = synth.render(options, layout, out, bar.count)
    if as_json:
        print_json(written)
    else:
        again = f", {written['resumed']} of them from before" if written["resumed"] else ""
        sys.stdout.write(f"{out}: {written['frames']} frames of {written['synth']} in layout {layout}{again}\n")
