"""Models of a camera between the light and the sensor: lens, vignetting, shutter, exposure.

Distortion is the radial-tangential model of D. Brown (1966) in OpenCV's order; the world is drawn undistorted and
larger, then mapped. Motion blur moves every pixel along its own image motion during the shutter time, which is known
from depth, the motion of the camera and that of what moves by itself. The latter is a layer of its own, as in M.
McGuire et al., "A reconstruction filter for plausible motion blur", I3D 2012, which smears over what lies behind it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera

Colour = NDArray[np.float32]
Depth = NDArray[np.float32]
Motion = NDArray[np.float32]

GAMMA = 2.2  # of the renderer's shader
LEAST_EXPOSURE = 0.25
GREY = 0.18  # linear light that automatic exposure brings the mean to
EXPOSURE_LAG = 0.3  # of the way to the wanted exposure (its logarithm) from one frame to the next
EXPOSURES = (LEAST_EXPOSURE, 12.0)
LONGEST_SHUTTER = 3.0  # times the shutter of an exposure of one; beyond that the gain grows
BLUR_TAPS = 8
LEAST_BLUR_PX = 0.7
LEAST_KNOWN = 0.05  # share of the shutter time in which what lies behind is seen
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


def image_motion(camera: Camera, depth: Depth, T_later_now: se3.Matrix) -> Motion:
    """Return where pixels of static things move (H, W, 2) px until ``later``; no depth counts as far away."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    return _motion_at(camera, x, y, depth, T_later_now)


def _motion_at(camera: Camera, x: Depth, y: Depth, depth: Depth, T_later_now: se3.Matrix) -> Motion:
    """Return how pixels (...) move, (..., 2) px, whose points move by T_later_now in the frame of the camera."""
    ray_x = (x - np.float32(camera.cx)) / np.float32(camera.fx)
    ray_y = (y - np.float32(camera.cy)) / np.float32(camera.fy)
    inverse = np.where(depth > 0, 1 / np.maximum(depth, np.float32(BEHIND_M)), 0).astype(np.float32)
    R, t = T_later_now[:3, :3].astype(np.float32), T_later_now[:3, 3].astype(np.float32)
    ahead = R[2, 0] * ray_x + R[2, 1] * ray_y + R[2, 2] + t[2] * inverse
    ahead = np.maximum(ahead, np.float32(BEHIND_M))
    right = (R[0, 0] * ray_x + R[0, 1] * ray_y + R[0, 2] + t[0] * inverse) / ahead
    down = (R[1, 0] * ray_x + R[1, 1] * ray_y + R[1, 2] + t[1] * inverse) / ahead
    motion: Motion = np.stack(
        [(right - ray_x) * np.float32(camera.fx), (down - ray_y) * np.float32(camera.fy)], axis=-1
    )
    return motion


def moving_motion(
    camera: Camera, depth: Depth, labels: NDArray[np.uint8], parts: Mapping[int, se3.Matrix]
) -> tuple[Motion, NDArray[np.bool_]] | None:
    """Return how the pixels of moving parts move, (H, W, 2) px, and which they are (H, W); None where there are none.

    ``parts`` gives by label the motion T_later_now of a part in the frame of the camera, which itself may move. Around
    the parts the motion of their nearest pixel goes on, because that is what is smeared over what lies behind them.
    """
    table = np.zeros(256, np.bool_)
    table[list(parts)] = True
    mask = table[labels]
    if not mask.any():
        return None
    seeds = np.zeros((*labels.shape, 2), np.float32)
    for number in np.unique(labels[mask]).tolist():
        rows, columns = np.nonzero(labels == number)
        at = columns.astype(np.float32), rows.astype(np.float32)
        seeds[rows, columns] = _motion_at(camera, *at, depth[rows, columns], parts[number])
    return _nearest_known(seeds, mask), mask


def blur(picture: Colour, motion: Motion) -> Colour:
    """Return the picture (H, W, 3) as seen while every pixel moves by ``motion`` (H, W, 2) px about where it is."""
    longest = _longest(motion[::8, ::8])
    if longest < LEAST_BLUR_PX:
        return picture
    return _smeared(picture, motion, longest)


def blur_moving(picture: Colour, motion: Motion, moving: Motion, mask: NDArray[np.bool_]) -> Colour:
    """Return the picture with what moves by itself, ``mask`` (H, W), smeared along ``moving`` over the rest.

    Both layers are blurred along their own motion (H, W, 2) px, and what moves covers the rest for the share of the
    time that it is there; the rest has nothing of it mixed in, and goes on behind it as it is at its edge.
    """
    longest, longest_moving = _longest(motion[::8, ::8]), _longest(moving[mask][::16])
    if max(longest, longest_moving) < LEAST_BLUR_PX:
        return picture
    inside = mask.astype(np.float32)[..., None]
    outside = 1 - inside
    behind = _smeared(np.concatenate([picture * outside, outside], axis=-1), motion, longest)
    in_front = _smeared(np.concatenate([picture * inside, inside], axis=-1), moving, longest_moving)
    known = behind[..., 3:]
    rest = np.where(known > LEAST_KNOWN, behind[..., :3] / np.maximum(known, np.float32(LEAST_KNOWN)), picture)
    rest[mask] = _nearest_known(rest, known[..., 0] > LEAST_KNOWN)[mask]
    blurred: Colour = in_front[..., :3] + (1 - in_front[..., 3:]) * rest
    return blurred


def _nearest_known(values: Colour, known: NDArray[np.bool_]) -> Colour:
    """Return values (H, W, C) with what is not known taken from the nearest pixel that is."""
    if not known.any():
        return values
    hidden = np.where(known, 0, 255).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_number = np.zeros((int(nearest.max()) + 1, values.shape[2]), np.float32)
    by_number[nearest[known]] = values[known]
    filled: Colour = by_number[nearest]
    return filled


def _longest(motion: Motion) -> float:
    """Return how far pixels move, but for the fastest of them."""
    return float(np.percentile(np.abs(motion).max(axis=-1), 95))


def _smeared(picture: Colour, motion: Motion, longest: float) -> Colour:
    """Return the mean of the picture (H, W, C) over the motion, in as many steps as ``longest`` px take."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    taps = int(np.clip(np.ceil(longest), 2, BLUR_TAPS))
    total = np.zeros_like(picture)
    for at in (np.arange(taps) + 0.5) / taps - 0.5:
        column, row = x + np.float32(at) * motion[..., 0], y + np.float32(at) * motion[..., 1]
        total += cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    smeared: Colour = total / np.float32(taps)
    return smeared
