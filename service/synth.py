"""The commands ``seamark synth``: what can be rendered, and rendering it to a folder."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from seamark.datasets_synth import lighting, optics, scenarios, sensor, specification, toy_names, trajectories
from seamark.datasets_synth.layouts import LAYOUTS
from seamark.datasets_synth.worlds import WORLDS
from seamark.datasets_synth.writing import write_sequence


@dataclass(frozen=True)
class RenderOptions:
    """What to render: a world or a scenario with its settings, and settings that take precedence; None is default."""

    world: str
    trajectory: str | None = None
    sensors: str | None = None
    condition: str | None = None
    seed: int | None = None
    frames: int | None = None

    def text(self, layout: str) -> str:
        """Return ``NAME[,key=value...]``, with the richest sensors that the layout can carry where none are named."""
        name, settings = scenarios.split(scenarios.expand(self.world))
        given = {key: str(value) for key, value in asdict(self).items() if key != "world" and value is not None}
        usual = {"sensors": LAYOUTS[layout].modes[0].value} if layout in LAYOUTS else {}
        return scenarios.join(name, {**usual, **settings, **given})


def render(
    options: RenderOptions, layout: str, out: Path, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Write a sequence to a folder, or finish writing it, and return what lies there; raises SeamarkError."""
    written = write_sequence(options.text(layout), layout, out, progress)
    return {
        "folder": str(written.folder),
        "layout": written.layout,
        "synth": written.name,
        "frames": written.frames,
        "resumed": written.resumed,
    }


def catalogue() -> dict[str, Any]:
    """Return everything that has a name, for people and programs."""
    worlds: list[dict[str, Any]] = [
        {
            "name": name,
            "trajectory": kind.trajectory,
            "frames": kind.frames,
            "sizes": list(kind.sizes),
            "closed": kind.route("full").closed,
        }
        for name, kind in WORLDS.items()
    ]
    plain = toy_names.ToySpecification()
    toy = {"name": toy_names.NAME, "trajectory": plain.trajectory, "frames": plain.frames, "sizes": [], "closed": True}
    return {
        "worlds": [*worlds, toy],
        "trajectories": {name: kind.description for name, kind in trajectories.KINDS.items()},
        "conditions": list(lighting.CONDITIONS),
        "sensors": [mode.value for mode in specification.SENSORS],
        "sensor_qualities": list(sensor.MODELS),
        "cameras": list(optics.MODELS),
        "layouts": {name: [mode.value for mode in layout.modes] for name, layout in LAYOUTS.items()},
        "scenarios": [
            {"number": one.number, "name": one.name, "synth": one.text, "purpose": one.purpose}
            for one in scenarios.SCENARIOS.values()
        ],
    }


def tables(content: dict[str, Any]) -> list[Table]:
    """Return the catalogue as tables."""
    worlds = Table("world", "closed", "trajectory", "frames", "sizes", title="Worlds", title_justify="left")
    for world in content["worlds"]:
        closed = "yes" if world["closed"] else "no"
        worlds.add_row(world["name"], closed, world["trajectory"], str(world["frames"]), ", ".join(world["sizes"]))
    ways = Table("trajectory", "what it is", title="Trajectories", title_justify="left")
    for name, description in content["trajectories"].items():
        ways.add_row(name, description)
    others = Table("setting", "values", title="Settings", title_justify="left")
    for setting, key in (
        ("condition", "conditions"),
        ("sensors", "sensors"),
        ("sensor", "sensor_qualities"),
        ("camera", "cameras"),
        ("layout", "layouts"),
    ):
        others.add_row(setting, ", ".join(content[key]))
    ready = Table("no", "scenario", "stands for", "purpose", title="Scenarios (synth:NAME)", title_justify="left")
    for one in content["scenarios"]:
        ready.add_row(str(one["number"]), one["name"], one["synth"], one["purpose"])
    return [worlds, ways, others, ready]
