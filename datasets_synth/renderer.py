"""SAPIEN as an off-line renderer on the CPU: colour and exact depth of a world of panels.

SAPIEN counts pixel centres at +0.5, so half a pixel is added to the principal point; its camera looks along x with y
left and z up. Only this module and the probe import sapien, and only when a renderer is made.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.world import World
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig

NEAR_M, FAR_M = 0.05, 60.0
MIPMAP_LEVELS = 8

Colour = NDArray[np.float32]


def devices() -> str:
    """Return a summary of the devices that can render; raises RuntimeError or ImportError where there is none."""
    import sapien

    sapien.set_log_level("error")
    summary = str(sapien.render.get_device_summary())
    sapien.Scene()
    return summary


def _pose(T_world_cam: se3.Matrix) -> Any:
    """Return the SAPIEN pose of a camera whose axes are x right, y down, z forward."""
    import sapien

    x, y, z, w = se3.to_quaternion(T_world_cam[:3, :3] @ se3.T_WORLD_LEVEL_CAM[:3, :3].T)
    return sapien.Pose(T_world_cam[:3, 3], [w, x, y, z])


def _component(panel: Panel) -> Any:
    """Return the panel as a mesh of two triangles with its picture; row 0 of a picture is v = 0."""
    import sapien.render as sr

    rgba = np.ascontiguousarray(cv2.cvtColor(panel.image, cv2.COLOR_BGR2RGBA))
    material = sr.RenderMaterial()
    material.base_color_texture = sr.RenderTexture2D(
        rgba, "R8G8B8A8Unorm", mipmap_levels=MIPMAP_LEVELS, filter_mode="linear", address_mode="mirror", srgb=True
    )
    material.roughness, material.specular, material.metallic = 0.95, 0.05, 0.0
    if panel.glow > 0:
        material.emission = [panel.glow, panel.glow, panel.glow, 1.0]
    bottom_first = panel.corners[[3, 2, 1, 0]].astype(np.float32)
    picture = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    normals = np.tile(panel.normal.astype(np.float32), (4, 1))
    body = sr.RenderBodyComponent()
    body.attach(sr.RenderShapeTriangleMesh(bottom_first, triangles, normals, picture, material))
    return body


class Renderer:
    """A world in front of a rig; raises ImportError or RuntimeError where sapien or a Vulkan device is missing."""

    def __init__(self, world: World, rig: Rig) -> None:
        import sapien

        sapien.set_log_level("error")
        sapien.render.set_global_config(
            max_num_materials=len(world.panels) + 64,
            max_num_textures=len(world.panels) + 64,
            default_mipmap_levels=MIPMAP_LEVELS,
        )
        self._scene = sapien.Scene()
        self._scene.set_ambient_light(world.ambient)
        for panel in world.panels:
            entity = sapien.Entity()
            entity.add_component(_component(panel))
            self._scene.add_entity(entity)
        for lamp in world.lamps:
            self._scene.add_point_light(lamp.position.tolist(), list(lamp.colour), shadow=False)
        self._left = self._camera("left", rig.cam0)
        self._right = None if rig.cam1 is None else self._camera("right", rig.cam1)
        self._T_left_right = rig.T_cam0_cam1

    def _camera(self, name: str, camera: Camera) -> Any:
        field_of_view = 2 * np.arctan(camera.height / 2 / camera.fy)
        made = self._scene.add_camera(name, camera.width, camera.height, field_of_view, NEAR_M, FAR_M)
        made.set_perspective_parameters(NEAR_M, FAR_M, camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, 0.0)
        return made

    def render(self, T_world_cam: se3.Matrix) -> tuple[Colour, NDArray[np.float32], Colour | None]:
        """Return BGR (H, W, 3) float32 in 0..255, depth (H, W) float32 m (0: nothing), and the right BGR or None."""
        self._left.entity.set_pose(_pose(T_world_cam))
        if self._right is not None and self._T_left_right is not None:
            self._right.entity.set_pose(_pose(T_world_cam @ self._T_left_right))
        self._scene.update_render()
        self._left.take_picture()
        depth = np.maximum(-self._left.get_picture("Position")[..., 2], 0)
        left = self._colour(self._left)
        if self._right is None:
            return left, depth, None
        self._right.take_picture()
        return left, depth, self._colour(self._right)

    @staticmethod
    def _colour(camera: Any) -> Colour:
        colour: Colour = np.asarray(camera.get_picture("Color")[..., 2::-1] * np.float32(255), np.float32)
        return colour
