"""`seamark demo`: the rendered loop through all three nodes, or the small kept one where nothing can be rendered."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from seamark.datasets_synth.scenario import NoVulkanDevice
from seamark.service.config import SeamarkConfig
from seamark.service.output import OutputError
from seamark.service.run import Progress, RunOptions, run
from seamark.service.sources.open import open_sources
from seamark.service.types import RunRecord

WORLD = "synth:loop,sensor=cheap"
KEPT = "synth:small_loop"
PICTURE = "demo.png"


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What the demo did; ``notice`` says in one sentence why the kept sequence was used, if it was."""

    record: RunRecord
    picture: Path
    notice: str | None


def demonstrate(out: Path, config: SeamarkConfig, progress: Progress | None = None) -> Demonstration:
    """Run the loop and leave ``demo.png`` beside the results; raises SeamarkError."""
    notice = None
    try:
        source, spec = open_sources([WORLD]), WORLD
    except NoVulkanDevice as error:
        notice = f"Nothing can be rendered here, so the small sequence that comes with Seamark is used ({error})."
        spec = KEPT
        source = open_sources([spec])
    record = run(source, RunOptions(out, sources=(spec,)), config, progress)
    picture = out / PICTURE
    try:
        shutil.copyfile(out / "trajectory.png", picture)
    except OSError as error:
        raise OutputError(f"{picture} cannot be written: {error.strerror}") from error
    return Demonstration(record, picture, notice)
