"""Image files to arrays, with every way in which a file can be broken told apart."""

import re
import stat
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8"
END_OF_IMAGE = 0xD9
# A small file may claim to be a huge image, which would keep a node busy for minutes.
MAX_PIXELS = 2**26
START_OF_SCAN = 0xDA
# The next marker inside entropy-coded data: FF00 is a stuffed byte, FFD0 to FFD7 are restarts, FFFF is padding.
MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")


class UnreadableImageError(SeamarkError):
    """An image file is missing, truncated or undecodable; the text says which and names no folder."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image as grey (H, W) or BGR (H, W, 3) uint8; raises UnreadableImageError.

    Sixteen bits are scaled by 1 / 257, floating point by 255 (0..1 is meant), transparency is left out.
    """
    return to_image(_decode(path), path.name)


def to_image(raw: NDArray[np.generic], name: str) -> NDArray[np.uint8]:
    """Convert what OpenCV decoded to grey (H, W) or BGR (H, W, 3) uint8; raises UnreadableImageError."""
    if raw.ndim == 3 and raw.shape[2] in (1, 2):
        raw = raw[:, :, 0]
    elif raw.ndim == 3 and raw.shape[2] == 4:
        raw = raw[:, :, :3]
    if raw.dtype == np.uint8:
        image = raw.astype(np.uint8, copy=False)
    elif raw.dtype == np.uint16:
        image = ((raw.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif raw.dtype in (np.float32, np.float64):
        image = np.rint(np.clip(np.nan_to_num(raw.astype(np.float64)), 0, 1) * 255).astype(np.uint8)
    else:
        raise UnreadableImageError(f"{name} has pixels of type {raw.dtype}, which no image should have")
    return np.ascontiguousarray(image)


def read_depth(path: Path) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Read depth (H, W): uint16 raw units, or float32 metres where NaN stays NaN; raises UnreadableImageError."""
    raw = _decode(path)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[:, :, 0]
    if raw.ndim != 2:
        raise UnreadableImageError(f"{path.name} has {raw.shape[2]} channels; depth has one")
    if raw.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(raw, np.uint16)
    if raw.dtype in (np.float32, np.float64):
        return np.ascontiguousarray(raw, np.float32)
    raise UnreadableImageError(f"{path.name} has pixels of type {raw.dtype}; depth is uint16 or float")


def decode(data: bytes, name: str) -> NDArray[np.generic]:
    """Decode an image as it is stored, BGR where coloured; raises UnreadableImageError that begins with the name."""
    if not data:
        raise UnreadableImageError(f"{name} is empty")
    if data.startswith(JPEG_SIGNATURE) and not jpeg_complete(data):
        raise UnreadableImageError(f"{name} is truncated: its end-of-image marker is missing")
    if data.startswith(PNG_SIGNATURE):
        _check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"), name)
        _check_png(data, name)
    try:
        image: NDArray[np.generic] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise UnreadableImageError(f"{name} cannot be decoded: {error.err}") from error
    if image is None or image.size == 0:
        raise UnreadableImageError(f"{name} cannot be decoded as an image")
    _check_size(image.shape[1], image.shape[0], name)
    return image


def jpeg_complete(data: bytes) -> bool:
    """Tell whether a JPEG reaches its end-of-image marker; one inside an embedded thumbnail does not count."""
    position = len(JPEG_SIGNATURE)
    while position + 2 <= len(data):
        if data[position] != 0xFF:
            return False
        marker = data[position + 1]
        if marker == END_OF_IMAGE:
            return True
        if marker == 0xFF:
            position += 1
            continue
        position += 2
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:
            continue
        position += int.from_bytes(data[position : position + 2], "big")
        if marker == START_OF_SCAN:
            following = MARKER_IN_SCAN.search(data, position)
            if following is None:
                return False
            position = following.start()
    return False


def _check_size(width: int, height: int, name: str) -> None:
    if width * height > MAX_PIXELS:
        raise UnreadableImageError(f"{name} has {width} x {height} pixels; {MAX_PIXELS} in all are the most")


def _check_png(data: bytes, name: str) -> None:
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        body = data[position + 4 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if len(checksum) < 4:
            break
        if zlib.crc32(body) != int.from_bytes(checksum, "big"):
            raise UnreadableImageError(f"{name} is damaged: a checksum does not agree")
        if body[:4] == b"IEND":
            return
        position += 12 + length
    raise UnreadableImageError(f"{name} is truncated: its end chunk is missing")


def _decode(path: Path) -> NDArray[np.generic]:
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # to open a named pipe would wait for ever
            raise UnreadableImageError(f"{path.name} is no file")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise UnreadableImageError(f"{path.name} is missing") from error
    except OSError as error:
        raise UnreadableImageError(f"{path.name} cannot be read: {error.strerror}") from error
    return decode(data, path.name)
