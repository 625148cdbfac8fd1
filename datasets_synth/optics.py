"""Models of a camera between the light and the sensor: lens, vignetting, shutter, exposure.

Distortion is the radial-tangential model of D. Brown (1966) in OpenCV's order; the world is drawn undistorted and
larger, then mapped. Motion blur moves every pixel along its own image motion during the shutter time, which is known
from depth and the motion of the camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera

Colour = NDArray[np.float32]
Depth = NDArray[np.float32]

GAMMA = 2.2  # of the renderer's shader
LEAST_EXPOSURE = 0.25
GREY = 0.18  # linear light that automatic exposure brings the mean to
EXPOSURE_LAG = 0.3  # of the way to the wanted exposure (its logarithm) from one frame to the next
EXPOSURES = (LEAST_EXPOSURE, 12.0)
LONGEST_SHUTTER = 3.0  # times the shutter of an exposure of one; beyond that the gain grows
BLUR_TAPS = 8
LEAST_BLUR_PX = 0.7
BEHIND_M = 0.05


@dataclass(frozen=True)
class CameraModel:
    """What a camera does to the light.

    ``vignetting`` is the share of light lost in the corners; ``shutter_s`` the shutter time at an exposure of one;
    ``automatic`` says whether the exposure follows the light.
    """

    distortion: tuple[float, ...] = ()
    vignetting: float = 0.0
    shutter_s: float = 0.0
    automatic: bool = False


MODELS = {
    "ideal": CameraModel(),
    "real": CameraModel((), 0.35, 0.008, True),
    "barrel": CameraModel((-0.2, 0.04, 0.0006, -0.0004), 0.5, 0.008, True),
}


@dataclass(frozen=True)
class Exposure:
    """How long the shutter was open (s), the gain that the sensor applied, and the factor on the light of both."""

    factor: float = 1.0
    shutter_s: float = 0.0
    gain: float = 1.0


def split_exposure(factor: float, model: CameraModel) -> Exposure:
    """Return how a camera reaches ``factor`` times the light: with a longer shutter first, then with gain."""
    longer = float(np.clip(factor, 1 / LONGEST_SHUTTER, LONGEST_SHUTTER))
    return Exposure(factor, model.shutter_s * longer, max(1.0, factor / longer))


class AutomaticExposure:
    """Follows the mean of what it meters, late by some frames; meter every frame, in order."""

    def __init__(self) -> None:
        self._logarithm: float | None = None

    def follow(self, metered: Colour) -> float:
        """Return the factor for this frame, chosen before it was seen; ``metered`` is BGR in 0..255, gamma coded."""
        mean = float(np.mean((metered / np.float32(255)) ** np.float32(GAMMA)))
        wanted = float(np.log(np.clip(GREY / max(mean, 1e-6), *EXPOSURES)))
        if self._logarithm is None:
            self._logarithm = wanted
        current = self._logarithm
        self._logarithm += EXPOSURE_LAG * (wanted - current)
        return float(np.exp(current))


def vignette(camera: Camera, lost: float) -> Depth | None:
    """Return what is left of gamma coded light (H, W, 1) when the corners lose ``lost`` of it; None for nothing."""
    if lost == 0:
        return None
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    squared = (x - camera.cx) ** 2 + (y - camera.cy) ** 2
    left: Depth = (1 - np.float32(lost) * squared / squared.max()) ** np.float32(1 / GAMMA)
    return left[..., None]


class Lens:
    """Maps pictures of an ideal pinhole camera, ``wide``, to those of a distorted one, ``camera``."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.wide = camera
        self._maps: tuple[Depth, Depth] | None = None
        if camera.distorted:
            y, x = np.mgrid[0 : camera.height, 0 : camera.width]
            ideal = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
            low, high = np.floor(ideal.min(axis=0)) - 2, np.ceil(ideal.max(axis=0)) + 2
            width, height = (high - low + 1).astype(int).tolist()
            self.wide = Camera(width, height, camera.fx, camera.fy, camera.cx - low[0], camera.cy - low[1])
            shape = (camera.height, camera.width)
            column, row = ((ideal - low).astype(np.float32)[:, axis].reshape(shape) for axis in range(2))
            self._maps = (column, row)

    def colour(self, picture: Colour) -> Colour:
        """Return the picture (H, W, 3) as the distorted camera sees it."""
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_CUBIC), np.float32)

    def depth(self, depth: Depth) -> Depth:
        """Return z depth (H, W) m as seen through the lens: exact on planes, taken from one side at edges."""
        if self._maps is None:
            return depth
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0).astype(np.float32)
        nearest = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST)
        blended = cv2.remap(inverse, *self._maps, cv2.INTER_LINEAR)  # 1 / z is linear over a plane's picture
        smooth = 1 / np.maximum(blended, 1e-6)
        trusted = (nearest > 0) & (np.abs(smooth - nearest) < 0.02 * nearest)
        mapped: Depth = np.where(trusted, smooth, nearest).astype(np.float32)
        return mapped

    def labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return labels (H, W) as seen through the lens."""
        if self._maps is None:
            return labels
        return np.asarray(cv2.remap(labels, *self._maps, cv2.INTER_NEAREST), np.uint8)


def image_motion(camera: Camera, depth: Depth, T_later_now: se3.Matrix) -> NDArray[np.float32]:
    """Return where pixels of static things move (H, W, 2) px until ``later``; no depth counts as far away."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    ray_x = (x - np.float32(camera.cx)) / np.float32(camera.fx)
    ray_y = (y - np.float32(camera.cy)) / np.float32(camera.fy)
    inverse = np.where(depth > 0, 1 / np.maximum(depth, np.float32(BEHIND_M)), 0).astype(np.float32)
    R, t = T_later_now[:3, :3].astype(np.float32), T_later_now[:3, 3].astype(np.float32)
    ahead = R[2, 0] * ray_x + R[2, 1] * ray_y + R[2, 2] + t[2] * inverse
    ahead = np.maximum(ahead, np.float32(BEHIND_M))
    right = (R[0, 0] * ray_x + R[0, 1] * ray_y + R[0, 2] + t[0] * inverse) / ahead
    down = (R[1, 0] * ray_x + R[1, 1] * ray_y + R[1, 2] + t[1] * inverse) / ahead
    motion: NDArray[np.float32] = np.stack(
        [(right - ray_x) * np.float32(camera.fx), (down - ray_y) * np.float32(camera.fy)], axis=-1
    )
    return motion


def blur(picture: Colour, motion: NDArray[np.float32]) -> Colour:
    """Return the picture (H, W, 3) as seen while every pixel moves by ``motion`` (H, W, 2) px about where it is."""
    longest = float(np.percentile(np.abs(motion[::8, ::8]).max(axis=-1), 95))
    if longest < LEAST_BLUR_PX:
        return picture
    height, width = picture.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    taps = int(np.clip(np.ceil(longest), 2, BLUR_TAPS))
    total = np.zeros_like(picture)
    for at in (np.arange(taps) + 0.5) / taps - 0.5:
        column, row = x + np.float32(at) * motion[..., 0], y + np.float32(at) * motion[..., 1]
        total += cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    blurred: Colour = total / np.float32(taps)
    return blurred
