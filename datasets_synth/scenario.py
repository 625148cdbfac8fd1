"""Synthetic sequences by name: rendered on the fly the first time, then read from the cache, with the same bits."""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from seamark import SeamarkError
from seamark.datasets_synth import fallback, folder, scenarios, sensor, specification, toy_names, trajectory
from seamark.datasets_synth.clearance import require_clear
from seamark.datasets_synth.rendering import NoVulkanDevice, RenderPool, require_renderer
from seamark.datasets_synth.sequence import GroundTruth, SynthSequence
from seamark.datasets_synth.specification import Specification
from seamark.frontend.types import Frame

__all__ = ["NoVulkanDevice", "SynthSequence", "cache_folder", "default_cache_dir", "open_synth"]


def default_cache_dir() -> Path:
    """Return $SEAMARK_CACHE, else $XDG_CACHE_HOME/seamark, else ~/.cache/seamark."""
    if own := os.environ.get("SEAMARK_CACHE"):
        return Path(own)
    if shared := os.environ.get("XDG_CACHE_HOME"):
        return Path(shared) / "seamark"
    return Path.home() / ".cache" / "seamark"


def cache_folder(wanted: Specification, cache_dir: Path | None = None) -> Path:
    """Return the folder in which the frames of a specification are kept once all of them have been rendered."""
    root = default_cache_dir() if cache_dir is None else cache_dir
    return root / "synth" / specification.content_hash(wanted)


def open_synth(spec: str, *, cache_dir: Path | None = None) -> SynthSequence:
    """Return the sequence that ``spec`` names: ``NAME[,key=value...]`` with the name of a scenario or of a world.

    ``toy`` and ``small_loop`` need no renderer. Frames of the others are rendered in worker processes when ``frames()``
    is first iterated, and kept under ``cache_dir``/synth once a pass is complete. Raises SeamarkError for unknown
    names, listing those that exist, and NoVulkanDevice where the sequence is not in the cache and nothing can render.
    """
    if spec == fallback.NAME:
        return fallback.open_small_loop()
    text = scenarios.expand(spec)
    if toy_names.is_toy(text):
        return toy_names.parse(text).open()
    wanted = specification.parse(text)
    finished = cache_folder(wanted, cache_dir)
    if not finished.is_dir():
        require_clear(wanted)
        require_renderer()
    truth = GroundTruth(trajectory.stamps(wanted.frames, specification.FPS), wanted.poses())

    def frames() -> Iterator[Frame]:
        if finished.is_dir():
            return folder.read_frames(finished, truth.stamps_ns)
        return _render(wanted, finished, truth)

    name = wanted.world if text == spec else spec.split(",")[0].strip()
    return SynthSequence(name, wanted.rig, wanted.mode, wanted.frames, truth, frames)


def _render(wanted: Specification, finished: Path, truth: GroundTruth) -> Iterator[Frame]:
    """Yield the frames as they are rendered and, after the last one, move them into the cache as a whole."""
    partial = finished.with_name(f".partial-{finished.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        _remove_leftovers(finished)
        folder.start(partial, wanted.mode)
        with RenderPool(wanted) as pool:
            for coded in pool.frames():
                folder.store(partial, coded)
                file = folder.names(coded.index)[0]
                yield sensor.decode(coded, int(truth.stamps_ns[coded.index]), file)
        folder.finish(partial, f"seamark synth {wanted}", wanted.mode, wanted.rig, truth)
        with contextlib.suppress(OSError):  # another run was faster: its folder is as good
            partial.rename(finished)
    except OSError as error:
        raise SeamarkError(f"rendered frames cannot be written to the cache {finished.parent}: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _remove_leftovers(finished: Path) -> None:
    """Remove what killed processes have left of this sequence."""
    for leftover in finished.parent.glob(f".partial-{finished.name}-*"):
        process = int(leftover.name.split("-")[-2])
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            shutil.rmtree(leftover, ignore_errors=True)
        except PermissionError:
            continue
