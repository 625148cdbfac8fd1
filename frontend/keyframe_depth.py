"""The depth image that a keyframe carries: small, as inverse depth, coded without loss.

A pixel stands for a square of pixels of the sensor. It holds the mean inverse depth of a square that shows one
surface, which has less noise than any of them, and nothing where a square spans an edge or is half empty. Inverse
depth is what a depth camera measures: its noise is about the same near and far, so one step suits all distances.
"""

import struct
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig

Depth = NDArray[np.uint16] | NDArray[np.float32]

STEPS: Final = 1024  # per 1/m: half a millimetre at 0.7 m, 16 mm at 4 m, less than the noise of such cameras
EDGE_SPREAD: Final = 0.05  # relative range of depth in a square that marks an edge
NOISE_SPREAD: Final = 6.0  # standard deviations that may lie between the extremes of a square
LARGEST_PX: Final = 4096  # a side of what is decoded
NOTHING: Final = b""
_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"


class DepthError(ValueError):
    """Bytes are not the depth image of a keyframe."""


def block_of(image_px: int, width_px: int) -> int:
    """Return the side in pixels of the squares that make an image ``image_px`` wide at least ``width_px`` wide."""
    return max(1, image_px // width_px)


def encode_depth(
    depth: Depth, depth_factor: float, config: FrontendConfig, mask: NDArray[np.uint8] | None = None
) -> bytes:
    """Return a depth image (H, W), uint16 in 1 / ``depth_factor`` m or float32 in m, as a PNG of 16 bits.

    Its pixels are inverse depths in 1 / STEPS per metre, 0 where nothing is known or the ``mask`` (H, W) is zero.
    NOTHING if none is wanted or the image is too small.
    """
    inverse = reduce_depth(depth, depth_factor, config, mask)
    if inverse.size == 0:
        return NOTHING
    steps = np.rint(np.minimum(inverse * STEPS, np.iinfo(np.uint16).max)).astype(np.uint16)
    ok, png = cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    assert ok, "a 16-bit image can be encoded"
    return png.tobytes()


def decode_depth(png: bytes) -> NDArray[np.float32]:
    """Return the inverse depth (h, w) in 1/m, 0 where unknown; raises DepthError for anything else."""
    # The size is looked at before anything is unpacked: a small file can claim to be a huge picture.
    if len(png) < 33 or png[:8] != _SIGNATURE or png[12:16] != b"IHDR":
        raise DepthError("the depth of a keyframe is no PNG file")
    width, height, bits, colour = struct.unpack(">IIBB", png[16:26])
    if not (0 < width <= LARGEST_PX and 0 < height <= LARGEST_PX and bits == 16 and colour == 0):
        raise DepthError(f"the depth of a keyframe is {width} x {height} pixels of {bits} bits")
    try:
        steps = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        steps = None
    if steps is None or steps.dtype != np.uint16 or steps.shape != (height, width):
        raise DepthError("the depth of a keyframe cannot be decoded")
    return steps.astype(np.float32) / np.float32(STEPS)


def reduce_depth(
    depth: Depth, depth_factor: float, config: FrontendConfig, mask: NDArray[np.uint8] | None = None
) -> NDArray[np.float32]:
    """Return the inverse depth (h, w) in 1/m of squares of :func:`block_of` pixels, 0 where unknown."""
    if config.keyframe_depth_px == 0:
        return np.zeros((0, 0), np.float32)
    block = block_of(depth.shape[1], config.keyframe_depth_px)
    h, w = depth.shape[0] // block, depth.shape[1] // block
    if h == 0 or w == 0 or w < block:  # so that the block follows from both widths
        return np.zeros((0, 0), np.float32)
    z = depth[: h * block, : w * block].astype(np.float32)
    if depth.dtype == np.uint16:
        z /= np.float32(depth_factor)
    with np.errstate(invalid="ignore"):
        known = (z > config.depth_min_m) & (z < config.depth_max_m)
    if mask is not None:
        known &= mask[: h * block, : w * block] > 0
    inverse = np.divide(1, z, out=np.zeros_like(z), where=known)
    share = cv2.resize(known.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    mean = cv2.resize(inverse, (w, h), interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    largest = _blocks(inverse, block, np.maximum)
    smallest = _blocks(np.where(known, inverse, np.float32(np.inf)), block, np.minimum)
    noise = config.depth_sigma_floor_m * mean**2 + config.depth_sigma_per_m2
    with np.errstate(invalid="ignore"):
        one_surface = largest - smallest < np.maximum(EDGE_SPREAD * mean, NOISE_SPREAD * noise)
    return np.where((share >= 0.5) & one_surface, mean, 0).astype(np.float32)


def _blocks(image: NDArray[np.float32], block: int, extreme: np.ufunc) -> NDArray[np.float32]:
    """Return the extreme of each square of an image whose sides are multiples of ``block``."""
    rows: NDArray[np.float32] = extreme.reduce(image.reshape(-1, block, image.shape[1]), axis=1)
    out: NDArray[np.float32] = extreme.reduce(rows.reshape(len(rows), -1, block), axis=2)
    return out
