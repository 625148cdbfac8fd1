"""A folder of images in natural order."""

import re
from pathlib import Path

from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode
from seamark.service.sources.base import Entry, FileSource, SourceError, file_source, offered
from seamark.service.stamps import running_stamp

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})
DEFAULT_FPS = 1.0


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a sort key under which ``image2`` comes before ``image10``."""
    parts = re.findall(r"(\d+)|(\D+)", name)
    return [(0, int(digits), "") if digits else (1, 0, text.lower()) for digits, text in parts], name


def list_images(folder: Path) -> list[Path]:
    """Return the image files of a folder in natural order; raises SourceError when it cannot be read."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    except OSError as error:
        raise SourceError(f"{folder} cannot be read as a folder of images: {error.strerror}") from error
    return sorted(files, key=lambda path: natural_key(path.name))


def open_images(
    folder: Path, *, rig: Rig | None, mode: Mode | None, fps: float | None = None, first_index: int = 0
) -> FileSource:
    """Open a folder of images; the stamps are (first_index + running index) / fps. Raises SourceError."""
    files = list_images(folder)
    if not files:
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(SUFFIXES))})")
    rate = fps or DEFAULT_FPS
    entries = [Entry(running_stamp(first_index + k, rate), path) for k, path in enumerate(files)]
    return file_source(folder, entries, rig, None, offered(rig, stereo=False, depth=False), mode)
