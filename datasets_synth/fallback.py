"""The small sequence that is kept in the package, for machines that cannot render."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np

from seamark import SeamarkError
from seamark.datasets_synth import folder, sensor, specification, trajectory
from seamark.datasets_synth.rendering import RenderPool
from seamark.datasets_synth.sequence import GroundTruth, SynthSequence
from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode

NAME = "small_loop"
SPECIFICATION = "loop,size=small,image=320x240,frames=220,sensors=rgbd"
DEPTH_FACTOR = 100.0  # whole centimetres: what makes the PNG files small
JPEG_OPTIONS = (
    *(cv2.IMWRITE_JPEG_QUALITY, 65),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
)


def small_loop_path() -> Path:
    """Return the folder of the kept RGB-D sequence, in TUM layout."""
    return Path(__file__).parent / NAME


def open_small_loop() -> SynthSequence:
    """Return the kept sequence."""
    path = small_loop_path()
    truth = folder.read_ground_truth(path)
    return SynthSequence(
        NAME, folder.read_rig(path), Mode.RGBD, len(truth), truth, lambda: folder.read_frames(path, truth.stamps_ns)
    )


def make_small_loop(target: Path) -> None:
    """Render the kept sequence into ``target``, which must not exist; how the folder in the package was made.

    Coded smaller than the cache: JPEG of lower quality, depth in whole centimetres.
    """
    if target.exists():
        raise SeamarkError(f"{target} exists already")
    wanted = specification.parse(SPECIFICATION)
    truth = GroundTruth(trajectory.stamps(wanted.frames, specification.FPS), wanted.poses())
    rig = Rig(wanted.rig.cam0, depth_factor=DEPTH_FACTOR)
    partial = target.with_name(f".{target.name}-{os.getpid()}")
    folder.start(partial, wanted.mode)
    try:
        with RenderPool(wanted) as pool:
            for coded in pool.frames():
                frame = sensor.decode(coded, 0, folder.names(coded.index)[0])
                assert frame.depth is not None
                depth = np.rint(frame.depth * (DEPTH_FACTOR / wanted.rig.depth_factor)).astype(np.uint16)
                picture = cv2.imencode(".jpg", frame.image, JPEG_OPTIONS)[1]
                png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
                folder.store(partial, sensor.CodedFrame(coded.index, bytes(picture), b"", bytes(png)))
        folder.finish(partial, f"seamark synth {wanted}", wanted.mode, rig, truth)
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
