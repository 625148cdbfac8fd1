"""TUM RGB-D folders: rgb.txt, depth.txt, associations.txt, groundtruth.txt (Sturm et al. 2012)."""

import logging
from pathlib import Path

import numpy as np

from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode
from seamark.service.evaluation import associate
from seamark.service.sources.base import Entry, FileSource, SourceError, file_source, offered
from seamark.service.stamps import parse_stamp
from seamark.service.trajectory_files import load_tum

MAX_DIFFERENCE_S = 0.02

logger = logging.getLogger(__name__)


def is_tum(folder: Path) -> bool:
    """Tell whether a folder looks like a TUM RGB-D sequence."""
    return (folder / "associations.txt").is_file() or (folder / "rgb.txt").is_file()


def open_tum(folder: Path, *, rig: Rig | None, mode: Mode | None) -> FileSource:
    """Open a TUM RGB-D sequence; the stamps are those of the colour images. Raises SourceError.

    Pairs are those of associations.txt (either image may come first), else the nearest within 20 ms, one to one; colour
    images without depth are then left out. Without depth.txt the sequence is one of plain images.
    """
    entries = _associated(folder) if (folder / "associations.txt").is_file() else _nearest(folder)
    truth = folder / "groundtruth.txt"
    modes = offered(rig, stereo=False, depth=entries[0].depth is not None)
    return file_source(folder, entries, rig, load_tum(truth) if truth.is_file() else None, modes, mode)


def _associated(folder: Path) -> list[Entry]:
    entries = []
    path = folder / "associations.txt"
    for number, fields in _lines(path):
        if len(fields) < 4:
            raise SourceError(f"{path}, line {number}: 'stamp file stamp file' was expected")
        colour, depth = (fields[:2], fields[2:4]) if not fields[1].startswith("depth") else (fields[2:4], fields[:2])
        entries.append(Entry(_stamp(path, number, colour[0]), folder / colour[1], depth=folder / depth[1]))
    return entries


def _nearest(folder: Path) -> list[Entry]:
    colours = _listed(folder / "rgb.txt")
    if not (folder / "depth.txt").is_file():
        return [Entry(stamp, folder / file) for stamp, file in colours]
    depths = _listed(folder / "depth.txt")
    i, j = associate(
        np.array([stamp for stamp, _ in colours], np.int64),
        np.array([stamp for stamp, _ in depths], np.int64),
        MAX_DIFFERENCE_S,
    )
    if len(i) == 0:
        raise SourceError(f"{folder}: no colour image has a depth image within {MAX_DIFFERENCE_S} s")
    if len(i) < len(colours):
        logger.warning("%s: %d of %d colour images have no depth image", folder, len(colours) - len(i), len(colours))
    return [
        Entry(colours[a][0], folder / colours[a][1], depth=folder / depths[b][1]) for a, b in zip(i, j, strict=True)
    ]


def _listed(path: Path) -> list[tuple[int, str]]:
    out = []
    for number, fields in _lines(path):
        if len(fields) < 2:
            raise SourceError(f"{path}, line {number}: 'stamp file' was expected")
        out.append((_stamp(path, number, fields[0]), fields[1]))
    return out


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(number, fields) for number, fields in lines if fields and not fields[0].startswith("#")]
    if not lines:
        raise SourceError(f"{path} names no images")
    return lines


def _stamp(path: Path, number: int, text: str) -> int:
    try:
        return parse_stamp(text)
    except ValueError as error:
        raise SourceError(f"{path}, line {number}: {error}") from error
