"""A toy world without a simulator: one textured room with pillars and crates, milliseconds per frame.

Every panel is intersected with the pixels' rays in closed form (on a plane, 1/z is linear in the pixel), so depth is
exact and the pictures obey the pinhole model with the centre of the top-left pixel at (0, 0).
"""

from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import prints, textures, trajectory
from seamark.datasets_synth.panels import Panel, Vector, box_faces, pixels
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.sequence import GroundTruth, SynthSequence
from seamark.datasets_synth.textures import Image
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig
from seamark.frontend.types import Frame, Mode

PIXELS_PER_METRE = 96.0
ROOM_SIZE = np.array([10.0, 8.0, 2.8])  # m, the origin in the middle of its floor
LAP_RADIUS_M = 2.4
LAPS = 1.08  # the last frames see what the first ones saw
EYE_HEIGHT_M = 1.2
NEAR_M = 0.05
LEVELS = 4
PADDING_PX = 8  # a multiple of 2 ** (LEVELS - 1), so that panels stay on whole pixels in all levels

Trajectory = Literal["loop", "line", "turn"]


def route() -> Route:
    """Return the way round the pillar, for ``trajectories.make_trajectory``: eight corners near the lap ``loop``."""
    angles = np.arange(8) * np.pi / 4
    ring = np.column_stack([LAP_RADIUS_M * np.cos(angles), LAP_RADIUS_M * np.sin(angles), np.full(8, EYE_HEIGHT_M)])
    return Route("toy", ring, True, 0.8, 0.9, 0.3)


def _room(rng: np.random.Generator) -> list[Panel]:
    """Return the inside of the room: walls with posters and stickers, floor, ceiling."""
    x, y, z = ROOM_SIZE / (2, 2, 1)
    up = np.array([0, 0, z])
    ring = [np.array([-x, -y, 0]), np.array([x, -y, 0]), np.array([x, y, 0]), np.array([-x, y, 0])]
    panels = []
    for left, right in zip([*ring[1:], ring[0]], ring, strict=True):
        surface = textures.WALLS[int(rng.integers(len(textures.WALLS)))]
        edge = right - left
        image = surface(rng, pixels(up, PIXELS_PER_METRE), pixels(edge, PIXELS_PER_METRE), PIXELS_PER_METRE)
        image = prints.add_stickers(rng, image, PIXELS_PER_METRE, 4)
        for slot in range(3):
            height, width = (int(PIXELS_PER_METRE * rng.uniform(0.8, 1.4)) for _ in range(2))
            column = int((slot + rng.uniform(0.1, 0.4)) * image.shape[1] / 3)
            row = int(rng.uniform(0.2, 0.9) * PIXELS_PER_METRE)
            image[row : row + height, column : column + width] = prints.poster(rng, height, width)
        panels.append(Panel(left + up, edge, -up, image))
    for level, depth in ((0.0, -2 * y), (z, 2 * y)):
        surface = textures.FLOORS[int(rng.integers(len(textures.FLOORS)))] if level == 0 else textures.plaster
        across, back = np.array([2 * x, 0, 0]), np.array([0, depth, 0])
        image = surface(rng, pixels(back, PIXELS_PER_METRE), pixels(across, PIXELS_PER_METRE), PIXELS_PER_METRE)
        image = prints.add_stickers(rng, image, PIXELS_PER_METRE, 3)
        panels.append(Panel(np.array([-x, -depth / 2, level]), across, back, image))
    return panels


def _things(rng: np.random.Generator) -> list[Panel]:
    """Return pillars inside the lap and crates around it."""
    places: list[tuple[Vector, Vector]] = [
        (np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4), 1.4]), np.array([1.0, 1.0, 2.8]))
    ]
    for octant in range(8):
        angle = (octant + rng.uniform(0.2, 0.8)) * np.pi / 4
        size = np.array([rng.uniform(0.4, 0.8), rng.uniform(0.4, 0.8), rng.uniform(0.5, 1.6)])
        direction = np.array([np.cos(angle), np.sin(angle)])
        reach = min(3.9 / max(1e-9, abs(direction[0])), 3.4 / max(1e-9, abs(direction[1])))
        places.append((np.array([*(reach * direction), size[2] / 2]), size))
    panels = []
    for centre, size in places:
        for corner, right, down in box_faces(centre, size, rng.uniform(0, np.pi)):
            shape = (pixels(down, PIXELS_PER_METRE), pixels(right, PIXELS_PER_METRE))
            image = prints.carton(rng, *shape) if rng.random() < 0.6 else prints.poster(rng, *shape)
            panels.append(Panel(corner, right, down, image))
    return panels


def _atlas(panels: list[Panel]) -> tuple[list[Image], NDArray[np.int64]]:
    """Return the mip levels of all pictures one below the other, and the first row (N,) of each in level 0."""
    rows, parts = [], []
    width = max(panel.image.shape[1] for panel in panels)
    row = 0
    for panel in panels:
        height, own = panel.image.shape[:2]
        fill = PADDING_PX + (-height) % PADDING_PX
        padding = (PADDING_PX, fill, PADDING_PX, PADDING_PX + (-width) % PADDING_PX + width - own)
        parts.append(cv2.copyMakeBorder(panel.image, *padding, cv2.BORDER_REPLICATE))
        rows.append(row + PADDING_PX)
        row += parts[-1].shape[0]
    levels = [np.vstack(parts)]
    for _ in range(1, LEVELS):
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels, np.array(rows)


class ToyWorld:
    """One room from a seed, seen by a perfect camera.

    ``size`` is (width, height) in pixels, ``focal_px`` defaults to 0.8125 of the width (63 degrees wide),
    ``baseline_m`` is that of the stereo rig and ``noise_grey`` the standard deviation of the image noise; depth has no
    noise.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        size: tuple[int, int] = (320, 240),
        focal_px: float | None = None,
        baseline_m: float = 0.12,
        noise_grey: float = 1.0,
        colour: bool = True,
    ) -> None:
        rng = np.random.default_rng([seed, 0x70])
        self.seed, self.baseline_m, self.noise_grey, self.colour = seed, baseline_m, noise_grey, colour
        focal = 0.8125 * size[0] if focal_px is None else focal_px
        self.camera = Camera(size[0], size[1], focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
        self.panels = _room(rng) + _things(rng)
        self._levels, self._rows = _atlas(self.panels)

    def rig(self, mode: Mode) -> Rig:
        """Return the calibration for ``mode``; stereo has the right camera ``baseline_m`` along +x of the left one."""
        if mode is not Mode.STEREO:
            return Rig(self.camera)
        return Rig(self.camera, self.camera, se3.make(np.eye(3), np.array([self.baseline_m, 0, 0])))

    def view(self, T_world_cam: se3.Matrix) -> tuple[Image, NDArray[np.float32]]:
        """Return what a camera sees: BGR uint8 (H, W, 3) without noise, and depth (H, W) float32 m (0: nothing)."""
        shape = (self.camera.height, self.camera.width)
        depth, footprint = np.full(shape, np.inf), np.ones(shape, np.float32)
        map_x, map_y = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for panel, row in zip(self.panels, self._rows, strict=True):
            self._draw(panel, float(row), T_world_cam, depth, map_x, map_y, footprint)
        image = self._sample(map_x, map_y, footprint)
        missing = ~np.isfinite(depth)
        image[missing], depth[missing] = 0, 0
        return image, depth.astype(np.float32)

    def render(self, T_world_cam: se3.Matrix, index: int = 0, stamp_ns: int = 0, sensors: Mode = Mode.RGBD) -> Frame:
        """Return the frame that ``sensors`` would give at ``T_world_cam``; depth is exact float32 m."""
        image, depth = self.view(T_world_cam)
        right = None
        if sensors is Mode.STEREO:
            right = self._finish(self.view(T_world_cam @ self._T_left_right())[0], index, 1)
        return Frame(
            index,
            stamp_ns,
            self._finish(image, index, 0),
            image_right=right,
            depth=depth if sensors is Mode.RGBD else None,
            file=f"toy/{index:06d}.png",
        )

    def _T_left_right(self) -> se3.Matrix:
        return se3.make(np.eye(3), np.array([self.baseline_m, 0, 0]))

    def _draw(
        self,
        panel: Panel,
        row: float,
        T_world_cam: se3.Matrix,
        depth: NDArray[np.float64],
        map_x: NDArray[np.float32],
        map_y: NDArray[np.float32],
        footprint: NDArray[np.float32],
    ) -> None:
        """Enter one panel into the depth buffer and, where it is the nearest, into the maps."""
        position = T_world_cam[:3, 3]
        facing = float(panel.normal @ (position - panel.corner))
        window = self._window(panel, T_world_cam)
        if facing <= 0 or window is None:
            return
        height, width = panel.image.shape[:2]
        per_right = panel.right / (panel.right @ panel.right) * width
        per_down = panel.down / (panel.down @ panel.down) * height
        towards, along, below = (self._linear(v, T_world_cam, window) for v in (-panel.normal, per_right, per_down))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            z = facing / towards
            x = per_right @ (position - panel.corner) + z * along
            y = per_down @ (position - panel.corner) + z * below
            seen = (z > NEAR_M) & (z < depth[window]) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
        depth[window][seen] = z[seen]
        map_x[window][seen] = x[seen] + (PADDING_PX - 0.5)
        map_y[window][seen] = y[seen] + (row - 0.5)
        scale = width / float(np.linalg.norm(panel.right)) / self.camera.fx
        footprint[window][seen] = scale * z[seen] / np.sqrt(np.clip(towards[seen], 0.05, 1))

    def _window(self, panel: Panel, T_world_cam: se3.Matrix) -> tuple[slice, slice] | None:
        """Return the rows and columns of the image that the panel can touch, or None."""
        corners = se3.transform(se3.inverse(T_world_cam), panel.corners)
        outline = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if a[2] > NEAR_M:
                outline.append(a)
            if (a[2] > NEAR_M) != (b[2] > NEAR_M):
                outline.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
        if not outline:
            return None
        points = self.camera.project_ideal(np.stack(outline))
        low = np.clip(np.floor(points.min(axis=0)), 0, (self.camera.width, self.camera.height)).astype(int)
        high = np.clip(np.ceil(points.max(axis=0)) + 1, 0, (self.camera.width, self.camera.height)).astype(int)
        return (slice(low[1], high[1]), slice(low[0], high[0])) if np.all(high > low) else None

    def _linear(self, v: Vector, T_world_cam: se3.Matrix, window: tuple[slice, slice]) -> NDArray[np.float64]:
        """Return v . ray for the rays (z = 1) of all pixels of the window."""
        a, b, c = T_world_cam[:3, :3].T @ v
        columns = (np.arange(window[1].start, window[1].stop) - self.camera.cx) / self.camera.fx
        rows = (np.arange(window[0].start, window[0].stop) - self.camera.cy) / self.camera.fy
        values: NDArray[np.float64] = (a * columns)[None] + (b * rows + c)[:, None]
        return values

    def _sample(self, map_x: NDArray[np.float32], map_y: NDArray[np.float32], footprint: NDArray[np.float32]) -> Image:
        """Look the pixels up between the two mip levels that fit their footprint (texture pixels per image pixel)."""
        level = np.clip(np.log2(np.maximum(footprint, 1e-3)), 0, LEVELS - 1.001)
        result = np.zeros((*map_x.shape, 3), np.float32)
        for k, picture in enumerate(self._levels):
            weight = np.maximum(0, 1 - np.abs(level - k))
            if not weight.any():
                continue
            scale = np.float32(0.5**k)
            x, y = (map_x + 0.5) * scale - 0.5, (map_y + 0.5) * scale - 0.5
            result += weight[..., None] * cv2.remap(picture, x, y, cv2.INTER_LINEAR)
        return textures.to_image(result)

    def _finish(self, image: Image, index: int, eye: int) -> Image:
        """Return the image in grey if asked for, with its noise."""
        plain: Image = image if self.colour else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self.noise_grey <= 0:
            return plain
        rng = np.random.default_rng([self.seed, index, eye])
        return textures.to_image(plain + np.float32(self.noise_grey) * rng.standard_normal(plain.shape, np.float32))


def toy_sequence(
    trajectory_name: Trajectory = "loop",
    n_frames: int = 120,
    seed: int = 0,
    sensors: Mode = Mode.RGBD,
    fps: float = 15.0,
    *,
    world: ToyWorld | None = None,
    poses: NDArray[np.float64] | None = None,
) -> SynthSequence:
    """Return a run through the toy world of ``seed`` (or through ``world``), along ``poses`` (N, 4, 4) where given.

    ``loop`` is 1.08 laps on a circle of 2.4 m (16.3 m), ``line`` at most 4 m of 4 cm steps looking 25 degrees aside,
    ``turn`` at most 2 rad of 2 degree steps on the spot. Raises SeamarkError for another trajectory or
    no frames.
    """
    if n_frames < 1:
        raise SeamarkError(f"a toy sequence needs at least one frame, not {n_frames}")
    world = ToyWorld(seed) if world is None else world
    if poses is not None:
        n_frames = len(poses)
    elif trajectory_name == "loop":
        poses = trajectory.circle(n_frames, LAP_RADIUS_M, EYE_HEIGHT_M, LAPS)
    elif trajectory_name == "line":
        start = np.array([-3.0, -2.2, EYE_HEIGHT_M])
        poses = trajectory.line(n_frames, start, min(4.0, 0.04 * (n_frames - 1)), np.deg2rad(-25))
    elif trajectory_name == "turn":
        centre = np.array([-LAP_RADIUS_M, 0.0, EYE_HEIGHT_M])
        poses = trajectory.turn(n_frames, centre, min(2.0, np.deg2rad(2.0) * (n_frames - 1)))
    else:
        raise SeamarkError(f"there is no toy trajectory {trajectory_name!r}; there are loop, line and turn")
    truth = GroundTruth(trajectory.stamps(n_frames, fps), poses)

    def frames() -> Iterator[Frame]:
        for index in range(n_frames):
            yield world.render(truth.T_world_cam[index], index, int(truth.stamps_ns[index]), sensors)

    return SynthSequence(f"toy-{trajectory_name}", world.rig(sensors), sensors, n_frames, truth, frames)
