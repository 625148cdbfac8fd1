"""Textured rectangles, out of which all worlds are built, and boxes made of them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.textures import Image

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Panel:
    """A rectangle with a picture, visible from its front only.

    ``corner`` (3,) is the top left corner as seen from the front; ``right`` and ``down`` (3,) are its edges in metres.
    The BGR picture covers the whole rectangle; ``glow`` adds light of its own (lamps). What is ``sky`` shines with
    daylight only (the sky, windows seen from inside). ``tiles`` says how often the picture is repeated, mirrored each
    time, along right and down. ``gloss`` from 0 to 1 is how much the surface mirrors lamps and the sun.
    """

    corner: Vector
    right: Vector
    down: Vector
    image: Image
    glow: float = 0.0
    sky: bool = False
    tiles: tuple[float, float] = (1.0, 1.0)
    gloss: float = 0.0

    @property
    def normal(self) -> Vector:
        """Return the unit normal (3,), towards those who see the front."""
        n = np.cross(self.down, self.right)
        return n / np.linalg.norm(n)

    @property
    def corners(self) -> Vector:
        """Return the corners (4, 3): top left, top right, bottom right, bottom left."""
        return np.stack(
            [self.corner, self.corner + self.right, self.corner + self.right + self.down, self.corner + self.down]
        )


def box_faces(centre: Vector, size: Vector, yaw: float = 0.0) -> list[tuple[Vector, Vector, Vector]]:
    """Return (corner, right, down) of the four sides and the top of an upright box, fronts outward.

    ``centre`` (3,) is the middle of the box, ``size`` (3,) its full extent in metres, turned about z by ``yaw``.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    axes = np.array([[c, s, 0.0], [-s, c, 0.0]])
    up = np.array([0.0, 0.0, 1.0])
    faces = []
    for out, out_length, right, right_length in (
        (axes[0], size[0], axes[1], size[1]),
        (axes[1], size[1], -axes[0], size[0]),
        (-axes[0], size[0], -axes[1], size[1]),
        (-axes[1], size[1], axes[0], size[0]),
    ):
        corner = centre + 0.5 * (out * out_length - right * right_length + up * size[2])
        faces.append((corner, right * right_length, -up * size[2]))
    top = centre + 0.5 * (up * size[2] - axes[0] * size[0] + axes[1] * size[1])
    faces.append((top, axes[0] * size[0], -axes[1] * size[1]))
    return faces


def moved(panel: Panel, yaw: float, shift: Vector) -> Panel:
    """Return the panel turned about the z axis by ``yaw``, then moved by ``shift`` (3,); the picture is shared."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(panel, corner=R @ panel.corner + shift, right=R @ panel.right, down=R @ panel.down)


def pixels(edge: Vector, pixels_per_metre: float) -> int:
    """Return how many pixels an edge (3,) of a panel needs."""
    return max(8, round(float(np.linalg.norm(edge)) * pixels_per_metre))
