"""Panels and people as meshes of SAPIEN; its own boxes mangle the pictures on them."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from seamark.datasets_synth.figures import Mesh
from seamark.datasets_synth.panels import Panel

MIPMAP_LEVELS = 8


def material_of(panel: Panel) -> Any:
    """Return the picture of a panel as a material."""
    import sapien.render as sr

    rgba = np.ascontiguousarray(cv2.cvtColor(panel.image, cv2.COLOR_BGR2RGBA))
    texture = sr.RenderTexture2D(
        rgba, "R8G8B8A8Unorm", mipmap_levels=MIPMAP_LEVELS, filter_mode="linear", address_mode="mirror", srgb=True
    )
    made = sr.RenderMaterial()
    if panel.sky:
        made.base_color = [0.0, 0.0, 0.0, 1.0]
        made.emission_texture = texture
    else:
        made.base_color_texture = texture
    made.roughness = 0.95 - 0.75 * panel.gloss
    made.specular = 0.05 + 0.95 * panel.gloss if panel.gloss > 0 else 0.0  # the shader leaves out what is matte
    return made


def panel_mesh(panels: Sequence[Panel], material: Any) -> Any:
    """Return panels that share a picture as one mesh; row 0 of a picture is v = 0."""
    import sapien.render as sr

    picture = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    corners = np.concatenate([panel.corners[[3, 2, 1, 0]].astype(np.float32) for panel in panels])
    places = np.concatenate([picture * np.array(panel.tiles, np.float32) for panel in panels])
    normals = np.concatenate([np.tile(panel.normal.astype(np.float32), (4, 1)) for panel in panels])
    two = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    triangles = np.concatenate([two + np.uint32(4 * number) for number in range(len(panels))])
    return sr.RenderShapeTriangleMesh(corners, triangles, normals, places, material)


def figure_mesh(mesh: Mesh) -> Any:
    """Return a mesh of somebody in matt cloth."""
    import sapien.render as sr

    corner = np.zeros(3)
    material = material_of(Panel(corner, corner, corner, mesh.image))
    return sr.RenderShapeTriangleMesh(mesh.vertices, mesh.triangles, mesh.normals, mesh.places, material)


def by_picture(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Return the panels in groups that share picture and light, in order of their first."""
    groups: dict[tuple[int, float, bool], list[Panel]] = {}
    for panel in panels:
        groups.setdefault((id(panel.image), panel.glow, panel.sky), []).append(panel)
    return list(groups.values())
