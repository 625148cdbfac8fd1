"""From what the user wrote to a source."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode
from seamark.service.calibration import load_calibration
from seamark.service.sources import images, video
from seamark.service.sources.base import Source, SourceError
from seamark.service.sources.chain import chain
from seamark.service.sources.euroc import is_euroc, open_euroc
from seamark.service.sources.images import list_images, open_images
from seamark.service.sources.kitti import is_kitti, open_kitti
from seamark.service.sources.synth import PREFIX, open_synth_source
from seamark.service.sources.tum import is_tum, open_tum
from seamark.service.sources.video import open_video

CALIBRATION = "calib.yaml"
# Stamps are whole nanoseconds and must neither repeat nor overflow.
MIN_FPS, MAX_FPS = 1e-3, 1e6


@dataclass(frozen=True)
class _Wish:
    """What the user asked for, besides the sources."""

    mode: Mode | None
    rig: Rig | None
    fps: float | None


def open_sources(
    specs: Sequence[str], *, mode: Mode | str | None = None, calib: Path | None = None, fps: float | None = None
) -> Source:
    """Open data sets, folders of images, videos and ``synth:NAME``, several of them as one sequence.

    ``mode`` is one that all of them offer; by default the richest of these. ``calib`` overrides every calibration of
    data on disk. ``fps`` gives the stamps of images and videos. Raises SourceError, CalibrationError or another
    SeamarkError with one sentence that says what is missing or wrong.
    """
    if not specs:
        raise SourceError("no source was given")
    if fps is not None and not MIN_FPS <= fps <= MAX_FPS:
        raise SourceError(f"the number of frames per second must be within {MIN_FPS:g} and {MAX_FPS:g}, not {fps:g}")
    rig = load_calibration(calib) if calib is not None else None
    wish = _Wish(_mode(mode), rig, fps)
    parts = _open_all(specs, wish)
    if len(parts) == 1:
        return parts[0]
    if wish.mode is None and len({part.mode for part in parts}) > 1:
        # What is the richest for one part may not be on offer by another.
        common = [one for one in parts[0].modes if all(one in part.modes for part in parts)]
        parts = _open_all(specs, _Wish(common[0], rig, fps))
    return chain(parts)


def _mode(mode: Mode | str | None) -> Mode | None:
    try:
        return None if mode is None else Mode(mode)
    except ValueError as error:
        raise SourceError(f"{mode!r} is not a mode; there are {', '.join(Mode)}") from error


def _open_all(specs: Sequence[str], wish: _Wish) -> list[Source]:
    parts: list[Source] = []
    # Folders of images that follow one another share one running index, and so their stamps run on exactly.
    running = 0
    for spec in specs:
        part = _open(spec, wish, running)
        plain = not spec.startswith(PREFIX) and _is_image_folder(Path(spec))
        running = running + (part.n_frames or 0) if plain else 0
        parts.append(part)
    return parts


def _open(spec: str, wish: _Wish, first_index: int) -> Source:
    if spec.startswith(PREFIX):
        return open_synth_source(spec, mode=wish.mode)
    path = Path(spec)
    if not path.exists():
        raise SourceError(f"{spec} does not exist")
    if path.is_file():
        return _open_file(path, wish)
    rig = wish.rig
    if rig is None and (path / CALIBRATION).is_file():
        rig = load_calibration(path / CALIBRATION)
    if is_tum(path):
        return open_tum(path, rig=rig, mode=wish.mode)
    if is_euroc(path):
        return open_euroc(path, rig=rig, mode=wish.mode)
    if is_kitti(path):
        return open_kitti(path, rig=rig, mode=wish.mode)
    if not list_images(path):
        raise SourceError(
            f"{spec} holds neither a data set (TUM RGB-D, EuRoC or KITTI odometry) nor images "
            f"({', '.join(sorted(images.SUFFIXES))})"
        )
    return open_images(path, rig=rig, mode=wish.mode, fps=wish.fps, first_index=first_index)


def _open_file(path: Path, wish: _Wish) -> Source:
    if path.suffix.lower() in images.SUFFIXES:
        raise SourceError(f"{path} is one image; give its folder")
    if path.suffix.lower() not in video.SUFFIXES:
        raise SourceError(f"{path} is neither a folder nor a video ({', '.join(sorted(video.SUFFIXES))})")
    return open_video(path, rig=wish.rig, mode=wish.mode, fps=wish.fps)


def _is_image_folder(path: Path) -> bool:
    return path.is_dir() and not (is_tum(path) or is_euroc(path) or is_kitti(path))
