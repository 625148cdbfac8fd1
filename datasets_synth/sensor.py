"""Models of RGB-D cameras, and how their frames are coded on disk and between processes.

The slowly varying relative error of depth over the image is that of A. Teichman, S. Miller, S. Thrun, "Unsupervised
intrinsic calibration of depth sensors via SLAM", RSS 2013; the noise that grows with the square of depth that of any
triangulating sensor.
"""

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth.textures import Image
from seamark.frontend.types import Frame

DEPTH_FACTOR = 5000.0  # raw units per metre, as in the TUM RGB-D sets
EDGE_JUMP = 0.1  # a window that spans two depths which differ by that share of the nearer one gives none
SHADOW_TOLERANCE_PX = 0.5
NOTHING_M = 1e6
DEPTH_NOISE_CELL_PX = 4
DISTORTION_CELLS = (4, 5)
DISTORTION_AT_M = 4.0
JPEG_QUALITY = 95
QUANTILES = 1 << 16


@dataclass(frozen=True)
class SensorModel:
    """How good a camera is.

    ``image_noise_grey`` is a standard deviation; ``depth_noise_per_m`` times z squared is that of depth: 0.001 is 1 mm
    at 1 m and 16 mm at 4 m. ``depth_distortion`` is the standard deviation over the image of the relative error of
    depth at 4 m, the same in all frames and proportional to depth, with a mean of zero. ``depth_step_m`` is what depth
    is rounded to. ``projector_m`` is how far right of the camera the pattern comes from that depth is measured by:
    there are holes to the left of near things, where it does not reach, and along all edges; with 0 there are none.
    """

    image_noise_grey: float
    depth_noise_per_m: float
    depth_distortion: float
    projector_m: float = 0.05
    depth_step_m: float = 0.001
    depth_range_m: tuple[float, float] = (0.3, 8.0)

    def distortion_field(self, height: int, width: int, seed: int) -> NDArray[np.float32]:
        """Return the relative error of depth (H, W) at DISTORTION_AT_M of one camera."""
        cells = np.random.default_rng([seed, 0xD157]).standard_normal(DISTORTION_CELLS, np.float32)
        smooth = cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC)
        field: NDArray[np.float32] = (smooth - smooth.mean()) / smooth.std() * np.float32(self.depth_distortion)
        return field


MODELS = {
    "ideal": SensorModel(0.0, 0.0, 0.0, 0.0, 1 / DEPTH_FACTOR, (0.0, np.iinfo(np.uint16).max / DEPTH_FACTOR)),
    "mild": SensorModel(2.0, 0.001, 0.0),
    "cheap": SensorModel(5.0, 0.003, 0.03, projector_m=0.075),
}


@dataclass(frozen=True)
class CodedFrame:
    """One frame as files: JPEG pictures, PNG depth and PNG labels (see renderer.View), empty where they are missing."""

    index: int
    left: bytes
    right: bytes = b""
    depth: bytes = b""
    labels: bytes = b""

    @property
    def blobs(self) -> tuple[bytes, bytes, bytes, bytes]:
        """Return the files: left and right picture, depth, labels."""
        return self.left, self.right, self.depth, self.labels


@cache
def _quantiles() -> NDArray[np.float32]:
    """Return the middles of QUANTILES equally likely parts of a normal distribution: fast to draw from."""
    normal = NormalDist()
    table = np.array([normal.inv_cdf((part + 0.5) / QUANTILES) for part in range(QUANTILES)], np.float32)
    table.setflags(write=False)
    return table


def expose(colour: NDArray[np.float32], model: SensorModel, rng: np.random.Generator, gain: float = 1.0) -> Image:
    """Return what the sensor reads of BGR light (H, W, 3) in 0..255: uint8 with noise.

    Noise is that of photons: at the same brightness of the picture it grows with the square root of the gain.
    """
    deviation = model.image_noise_grey * float(np.sqrt(gain))
    noise = np.take(_quantiles(), rng.integers(0, QUANTILES, colour.shape, np.uint16))
    return np.asarray(cv2.addWeighted(noise, deviation, colour, 1.0, 0.0, dtype=cv2.CV_8U), np.uint8)


def measure_depth(
    depth: NDArray[np.float32],
    distortion: NDArray[np.float32],
    model: SensorModel,
    rng: np.random.Generator,
    focal_px: float,
) -> NDArray[np.uint16]:
    """Return raw depth (H, W) in 1 / DEPTH_FACTOR m: distorted, noise growing with z squared, in steps, with holes.

    0 is a hole: out of range, at an edge, or in the shadow of something nearer. The noise is alike over
    DEPTH_NOISE_CELL_PX pixels, because such cameras match windows and not single pixels.
    """
    height, width = depth.shape
    cells = rng.standard_normal((height // DEPTH_NOISE_CELL_PX + 1, width // DEPTH_NOISE_CELL_PX + 1), np.float32)
    smooth = cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)
    per_square = distortion / np.float32(DISTORTION_AT_M) + np.float32(1.5 * model.depth_noise_per_m) * smooth
    noisy = depth + depth**2 * per_square  # 1.5, because linear interpolation leaves 1 / 1.5 of the noise
    steps = np.rint(noisy / np.float32(model.depth_step_m))
    near, far = model.depth_range_m
    seen = (depth >= near) & (noisy >= near) & (noisy <= far)
    if model.projector_m > 0:
        seen &= ~holes(depth, model.projector_m * focal_px)
    raw = np.where(seen, steps * (model.depth_step_m * DEPTH_FACTOR), 0)
    measured: NDArray[np.uint16] = np.rint(raw).astype(np.uint16)
    return measured


def holes(depth: NDArray[np.float32], projector_px_m: float) -> NDArray[np.bool_]:
    """Return where (H, W) the pattern of a projector to the right does not reach or windows span an edge.

    ``projector_px_m`` is its distance from the camera times the focal length. The pattern meets the surface of a pixel
    where no pixel farther right meets the same or an earlier column of it.
    """
    depth = np.where(depth > 0, depth, np.float32(NOTHING_M))
    window = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(depth, window)
    edges = cv2.dilate(depth, window) > (1 + EDGE_JUMP) * nearest
    columns = np.arange(depth.shape[1], dtype=np.float32) - np.float32(projector_px_m) / depth
    first = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    found: NDArray[np.bool_] = edges | (columns > first + SHADOW_TOLERANCE_PX)
    return found


def code_picture(image: Image) -> bytes:
    """Return the image as JPEG."""
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def code_depth(raw: NDArray[np.uint16]) -> bytes:
    """Return raw depth as 16 bit PNG, coded fast rather than small."""
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    return bytes(cv2.imencode(".png", raw, fast)[1])


def code_labels(labels: NDArray[np.uint8]) -> bytes:
    """Return labels as 8 bit PNG."""
    return bytes(cv2.imencode(".png", labels, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1])


def decode(coded: CodedFrame, stamp_ns: int, file: str) -> Frame:
    """Return the frame; raises SeamarkError where a file cannot be decoded."""
    left = _pixels(coded.left, cv2.IMREAD_COLOR, "picture", file)
    right = _pixels(coded.right, cv2.IMREAD_COLOR, "right picture", file) if coded.right else None
    depth = None
    if coded.depth:
        depth = _pixels(coded.depth, cv2.IMREAD_UNCHANGED, "depth", file).astype(np.uint16, copy=False)
    return Frame(coded.index, stamp_ns, left, image_right=right, depth=depth, file=file)


def decode_labels(coded: CodedFrame, file: str) -> NDArray[np.uint8]:
    """Return the labels (H, W) of a frame (renderer.View); raises SeamarkError where there are none to decode."""
    return _pixels(coded.labels, cv2.IMREAD_UNCHANGED, "labels", file)


def _pixels(blob: bytes, flags: int, what: str, file: str) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(blob, np.uint8), flags) if blob else None
    if image is None:
        raise SeamarkError(f"the {what} of rendered frame {file} cannot be decoded; delete its folder to render again")
    image.setflags(write=False)
    return np.asarray(image)
