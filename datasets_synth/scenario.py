"""Synthetic sequences by name: rendered on the fly the first time, then read from the cache, with the same bits."""

import contextlib
import os
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import fallback, folder, scenarios, sensor, specification, staging, toy_names, trajectory
from seamark.datasets_synth.clearance import require_clear
from seamark.datasets_synth.rendering import NoVulkanDevice, RenderPool, require_renderer
from seamark.datasets_synth.sensor import CodedFrame
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
    kept, comma, _ = spec.partition(",")
    if kept.strip() == fallback.NAME:
        if comma:
            raise SeamarkError(f"{fallback.NAME} is kept as it is and takes no settings; loop,size=small does")
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
        with contextlib.closing(_coded(wanted, finished, truth)) as all_coded:
            for coded in all_coded:
                yield sensor.decode(coded, int(truth.stamps_ns[coded.index]), folder.names(coded.index)[0])

    def labels() -> Iterator[NDArray[np.uint8]]:
        with contextlib.closing(_coded(wanted, finished, truth)) as all_coded:
            for coded in all_coded:
                yield sensor.decode_labels(coded, folder.labels_name(coded.index))

    name = wanted.world if text == spec else spec.split(",")[0].strip()
    shown = labels if wanted.labels else None
    return SynthSequence(name, wanted.rig, wanted.mode, wanted.frames, truth, frames, shown)


def _coded(wanted: Specification, finished: Path, truth: GroundTruth) -> Generator[CodedFrame, None, None]:
    """Yield the frames from the cache, or else as they are rendered and, after the last one, kept as a whole.

    What a killed process had rendered is not rendered again.
    """
    if finished.is_dir():
        yield from (folder.read_coded(finished, index) for index in range(wanted.frames))
        return
    labels = wanted.labels > 0
    try:
        with staging.growing(finished) as partial:
            folder.start(partial, wanted.mode, labels=labels)
            begin = min(folder.stored(partial, wanted.mode, labels=labels), wanted.frames)
            yield from (folder.read_coded(partial, index) for index in range(begin))
            if begin < wanted.frames:
                with RenderPool(wanted, begin) as pool:
                    for coded in pool.frames():
                        folder.store(partial, coded)
                        yield coded
            folder.finish(partial, f"seamark synth {wanted}", wanted.mode, wanted.rig, truth)
            with contextlib.suppress(OSError):  # another run was faster: its folder is as good
                partial.rename(finished)
    except OSError as error:
        raise SeamarkError(f"rendered frames cannot be written to the cache {finished.parent}: {error}") from error
