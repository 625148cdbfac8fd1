"""SAPIEN as an off-line renderer on the CPU: colour and exact depth of a world of panels.

SAPIEN counts pixel centres at +0.5, so half a pixel is added to the principal point; its camera looks along x with y
left and z up. Only this module, ``meshes`` and the probe import sapien, and only when a renderer is made. The shaders
are our own (``shaders/``): a quarter of the cost of SAPIEN's, and they start at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import figures, meshes
from seamark.datasets_synth.figures import Figure
from seamark.datasets_synth.lighting import DAY, Illumination
from seamark.datasets_synth.optics import GAMMA
from seamark.datasets_synth.panels import Panel, Vector
from seamark.datasets_synth.world import World
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig

SHADERS = Path(__file__).parent / "shaders"
NEAR_M = 0.05
METER_SCALE = 10  # the picture that exposure is metered on is so many times smaller
NOWHERE = np.array([0.0, 0.0, -500.0])  # where movers wait that are not there
LABEL_NOTHING, LABEL_STATIC, LABEL_SKY = 0, 1, 2

Colour = NDArray[np.float32]


def devices() -> str:
    """Return a summary of the devices that can render; raises RuntimeError or ImportError where there is none."""
    import sapien

    sapien.set_log_level("error")
    summary = str(sapien.render.get_device_summary())
    sapien.Scene()
    return summary


@dataclass(frozen=True, eq=False)
class View:
    """What the rig sees: BGR (H, W, 3) float32 in 0..255, gamma coded, and z depth (H, W) m of the left camera.

    Depth 0 is nothing. ``labels`` (H, W) uint8, if asked for: 0 nothing, 1 static, 2 sky, and parts of people as in
    figures.label. ``right_depth`` and ``right_labels`` come if asked for.
    """

    left: Colour
    depth: NDArray[np.float32]
    right: Colour | None = None
    labels: NDArray[np.uint8] | None = None
    right_depth: NDArray[np.float32] | None = None
    right_labels: NDArray[np.uint8] | None = None


def _pose(T_world_cam: se3.Matrix) -> Any:
    """Return the SAPIEN pose of a camera whose axes are x right, y down, z forward."""
    import sapien

    x, y, z, w = se3.to_quaternion(T_world_cam[:3, :3] @ se3.T_WORLD_LEVEL_CAM[:3, :3].T)
    return sapien.Pose(T_world_cam[:3, 3], [w, x, y, z])


class Renderer:
    """A world in front of a rig; raises ImportError or RuntimeError where sapien or a Vulkan device is missing.

    ``movers`` are people; :meth:`place` moves them.
    """

    def __init__(self, world: World, rig: Rig, movers: Sequence[Figure] = (), *, meter: bool = False) -> None:
        import sapien

        sapien.set_log_level("error")
        most = len(world.panels) + sum(len(part.meshes) for mover in movers for part in mover.parts) + 64
        sapien.render.set_global_config(
            max_num_materials=most, max_num_textures=most, default_mipmap_levels=meshes.MIPMAP_LEVELS
        )
        sapien.render.set_camera_shader_dir(str(SHADERS))
        self._world = world
        self._scene = sapien.Scene()
        self._scene.set_ambient_light(world.ambient)
        self._glowing: list[tuple[Any, Panel, bool]] = []  # with whether its lamp has an odd number
        self._labels = np.zeros(1, np.uint8)
        for group in meshes.by_picture(world.panels):
            self._add([group], LABEL_SKY if group[0].sky and world.sun is not None else LABEL_STATIC)
        self._movers = [
            [
                self._enter([meshes.figure_mesh(mesh) for mesh in part.meshes], figures.label(k, number))
                for number, part in enumerate(mover.parts)
            ]
            for k, mover in enumerate(movers)
        ]
        shown = world.lamps[: world.lamps_at_once] if world.lamps_at_once else world.lamps
        self._lamps = [
            self._scene.add_point_light(lamp.position.tolist(), list(lamp.colour), shadow=False) for lamp in shown
        ]
        self._sun = None
        if world.sun is not None:
            self._sun = self._scene.add_directional_light(
                world.sun.direction.tolist(), list(world.sun.colour), shadow=False
            )
        self._light = DAY
        self._left = self._camera("left", rig.cam0)
        self._right = None if rig.cam1 is None else self._camera("right", rig.cam1)
        self._meter = self._camera("meter", _smaller(rig.cam0)) if meter else None
        self._T_left_right = rig.T_cam0_cam1

    def _add(self, groups: Sequence[Sequence[Panel]], label: int) -> Any:
        shapes = []
        for group in groups:
            material = meshes.material_of(group[0])
            if group[0].glow > 0 or group[0].sky:
                self._glowing.append((material, group[0], len(group) == 1 and self._is_odd(group[0])))
                self._glow(*self._glowing[-1], DAY)
            shapes.append(meshes.panel_mesh(group, material))
        return self._enter(shapes, label)

    def _enter(self, shapes: Sequence[Any], label: int) -> Any:
        """Put shapes into the scene as one thing."""
        import sapien

        entity, body = sapien.Entity(), sapien.render.RenderBodyComponent()
        for shape in shapes:
            body.attach(shape)
        entity.add_component(body)
        self._scene.add_entity(entity)
        if entity.per_scene_id >= len(self._labels):
            self._labels = np.pad(self._labels, (0, entity.per_scene_id + 1 - len(self._labels)))
        self._labels[entity.per_scene_id] = label
        return entity

    def _camera(self, name: str, camera: Camera) -> Any:
        field_of_view = 2 * np.arctan(camera.height / 2 / camera.fy)
        far = self._world.far_m
        made = self._scene.add_camera(name, camera.width, camera.height, field_of_view, NEAR_M, far)
        made.set_perspective_parameters(NEAR_M, far, camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, 0.0)
        return made

    def _is_odd(self, panel: Panel) -> bool:
        """Return whether the lamp nearest to a glowing panel has an odd number."""
        away = [float(np.linalg.norm(lamp.position - panel.corner)) for lamp in self._world.lamps]
        return bool(away) and int(np.argmin(away)) % 2 == 1

    @staticmethod
    def _glow(material: Any, panel: Panel, odd: bool, light: Illumination) -> None:
        factors: Sequence[float] = [min(1.0, 1.2 * max(light.lamps) * (max(light.odd_lamps) if odd else 1.0))] * 3
        if panel.sky:
            factors = light.sky
        material.emission = [*(panel.glow * factor for factor in factors), 1.0]

    def _lamp_colour(self, number: int) -> list[float]:
        """Return the colour of a lamp in the present light."""
        odd = self._light.odd_lamps if number % 2 else DAY.odd_lamps
        return [a * b * c for a, b, c in zip(self._world.lamps[number].colour, self._light.lamps, odd, strict=True)]

    def illuminate(self, light: Illumination) -> None:
        """Change the light from now on."""
        if light == self._light:
            return
        self._light = light
        world = self._world
        self._scene.set_ambient_light([a * b for a, b in zip(world.ambient, light.ambient, strict=True)])
        if self._sun is not None and world.sun is not None:
            self._sun.color = [a * b for a, b in zip(world.sun.colour, light.sun, strict=True)]
        if not world.lamps_at_once:
            for number, shown in enumerate(self._lamps):
                shown.color = self._lamp_colour(number)
        for material, panel, odd in self._glowing:
            self._glow(material, panel, odd, light)

    def place(self, mover: int, T_world_part: se3.Matrix | None) -> None:
        """Put the parts of a mover to their poses (P, 4, 4); None takes it out of the world."""
        import sapien

        for number, entity in enumerate(self._movers[mover]):
            if T_world_part is None:
                entity.set_pose(_at(NOWHERE))
                continue
            x, y, z, w = se3.to_quaternion(T_world_part[number, :3, :3])
            entity.set_pose(sapien.Pose(T_world_part[number, :3, 3], [w, x, y, z]))

    def _choose_lamps(self, eye: Vector) -> None:
        """Light the nearest lamps; the last of them fades out before another takes its place."""
        lamps = self._world.lamps
        distances = np.array([np.linalg.norm(lamp.position - eye) for lamp in lamps])
        order = np.argsort(distances, kind="stable")
        count = len(self._lamps)
        edge = distances[order[count]] if len(lamps) > count else np.inf
        for shown, number in zip(self._lamps, order[:count], strict=True):
            fade = min(1.0, (edge - distances[number]) / (0.3 * edge)) if np.isfinite(edge) else 1.0
            shown.entity.set_pose(_at(lamps[number].position))
            shown.color = [fade * channel for channel in self._lamp_colour(int(number))]

    def meter(self, T_world_cam: se3.Matrix) -> Colour:
        """Return a small picture at an exposure of one, to choose an exposure by; only where ``meter`` was asked."""
        assert self._meter is not None
        self._update(T_world_cam, [self._meter])
        self._meter.take_picture()
        return self._colour(self._meter)

    def _update(self, T_world_cam: se3.Matrix, cameras: Sequence[Any]) -> None:
        if self._world.lamps_at_once:
            self._choose_lamps(T_world_cam[:3, 3])
        for camera in cameras:
            camera.entity.set_pose(_pose(T_world_cam))
        self._scene.update_render()

    def render(
        self, T_world_cam: se3.Matrix, *, exposure: float = 1.0, labels: bool = False, right_depth: bool = False
    ) -> View:
        """Return what the rig sees from ``T_world_cam``.

        ``exposure`` is a factor on all light; it is applied here and not by SAPIEN, whose cameras leak memory whenever
        theirs is changed.
        """
        if self._right is not None and self._T_left_right is not None:
            self._right.entity.set_pose(_pose(T_world_cam @ self._T_left_right))
        gain = exposure ** (1 / GAMMA)
        self._update(T_world_cam, [self._left])
        self._left.take_picture()
        left = self._colour(self._left, gain)
        depth, marked = self._geometry(self._left, labels)
        if self._right is None:
            return View(left, depth, None, marked)
        self._right.take_picture()
        right_eye = self._geometry(self._right, labels) if right_depth else (None, None)
        return View(left, depth, self._colour(self._right, gain), marked, *right_eye)

    def _geometry(self, camera: Any, labels: bool) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        """Return the depth of what a camera saw, and its labels if asked for."""
        entity, depth = cv2.split(camera.get_picture("Segmentation").view(np.float32))[:2]
        return depth, self._labels[entity.view(np.uint32)] if labels else None

    @staticmethod
    def _colour(camera: Any, gain: float = 1.0) -> Colour:
        """Return what a camera saw, as bright as a sensor can tell."""
        colour = cv2.cvtColor(camera.get_picture("Color"), cv2.COLOR_BGRA2BGR)
        if gain != 1:
            colour *= np.float32(gain)
        brightest: Colour = np.minimum(colour, np.float32(255), out=colour)
        return brightest


def _at(position: Vector) -> Any:
    import sapien

    return sapien.Pose(position)


def _smaller(camera: Camera) -> Camera:
    """Return a camera with the same view in fewer pixels."""
    s = METER_SCALE
    width, height = camera.width // s, camera.height // s
    return Camera(width, height, camera.fx / s, camera.fy / s, (width - 1) / 2, (height - 1) / 2)
