"""People as meshes: rounded bodies, heads with faces, and legs and arms that swing when they walk."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import prints, textures
from seamark.datasets_synth.textures import Image, noise, random_colour, tint, to_image
from seamark.frontend import se3

PIXELS_PER_METRE = 260.0
SEGMENTS = 18  # round a body
SWING_RAD = 0.5  # of a leg at WALK_M_S
WALK_M_S = 1.2
STRIDE_SHARE = 0.8  # of the height: what two steps cover
PARTS = ("body", "left leg", "right leg", "left arm", "right arm")
FIRST_LABEL, LABELS_EACH = 32, 8
FIRST_PERSON = 10  # number of the first in labels without parts
MOST_PEOPLE = (256 - FIRST_LABEL) // LABELS_EACH


def label(person: int, part: int) -> int:
    """Return the label of the pixels that show a part (see PARTS) of a person, by number."""
    return FIRST_LABEL + LABELS_EACH * person + part


def whole_people(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return labels in which all parts of person k are 10 + k."""
    numbers = np.arange(256)
    table = np.where(numbers < FIRST_LABEL, numbers, FIRST_PERSON + (numbers - FIRST_LABEL) // LABELS_EACH)
    return table.astype(np.uint8)[labels]


Colour = NDArray[np.float64]  # BGR
Ring = tuple[float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a picture: ``vertices``, ``normals`` (N, 3), ``places`` (N, 2) in the picture, 0 to 1 from its
    top left, and ``triangles`` (M, 3) that are seen anticlockwise.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    places: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    image: Image


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part of somebody: meshes about its ``joint`` (3,) m, and the sense in which it swings, 0 for not."""

    meshes: tuple[Mesh, ...]
    joint: NDArray[np.float64]
    swing: float = 0.0


@dataclass(frozen=True, eq=False)
class Figure:
    """Somebody standing at the origin and facing x, in the order of PARTS; ``tall`` and ``wide`` in m."""

    parts: tuple[Part, ...]
    tall: float
    wide: float

    def poses(self, position: NDArray[np.float64], yaw: float, phase: float, pace_m_s: float) -> NDArray[np.float64]:
        """Return T_world_part (P, 4, 4) at ``position`` (3,), facing ``yaw``, ``phase`` rad into a stride at a pace."""
        T_world_figure = se3.make(se3.exp_rotation(np.array([0.0, 0.0, yaw])), position)
        swing = SWING_RAD * min(1.3, pace_m_s / WALK_M_S) * float(np.sin(phase))
        poses = []
        for part in self.parts:
            R = se3.exp_rotation(np.array([0.0, part.swing * swing, 0.0]))
            poses.append(T_world_figure @ se3.make(R, part.joint))
        return np.stack(poses)


def lofted(rings: NDArray[np.float64], image: Image) -> Mesh:
    """Return the skin over elliptic rings (R, 5) from top to bottom: z, middle x and y, half extents along x and y.

    The picture goes once round, its left and right edges meeting at the back.
    """
    angles = np.linspace(-np.pi, np.pi, SEGMENTS + 1)
    z, x, y, deep, wide = (column[:, None] for column in rings.T)
    points = np.stack(
        [x + deep * np.cos(angles), y + wide * np.sin(angles), np.broadcast_to(z, (len(rings), 1)) + 0 * angles], -1
    )
    along = np.gradient(points, axis=0)
    tangents = np.stack([-deep * np.sin(angles), wide * np.cos(angles), np.zeros((len(rings), SEGMENTS + 1))], -1)
    normals = np.cross(along, tangents)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(rings[:, [0, 3, 4]], axis=0), axis=1))])
    u, v = np.meshgrid(np.linspace(0, 1, SEGMENTS + 1), lengths / lengths[-1])
    first = (np.arange(len(rings) - 1)[:, None] * (SEGMENTS + 1) + np.arange(SEGMENTS)).ravel()
    below = first + SEGMENTS + 1
    triangles = np.concatenate([np.stack([below, below + 1, first + 1], -1), np.stack([below, first + 1, first], -1)])
    return Mesh(
        points.reshape(-1, 3).astype(np.float32),
        normals.reshape(-1, 3).astype(np.float32),
        np.stack([u, v], -1).reshape(-1, 2).astype(np.float32),
        triangles.astype(np.uint32),
        image,
    )


def _cloth(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a checked, striped, patterned or plain garment with folds."""
    kind = int(rng.integers(4))
    folds = 0.14 * noise(rng, height, width, 0.25 * PIXELS_PER_METRE, 4) + 0.05 * noise(rng, height, width, 5, 2)
    if kind == 0:
        return to_image(textures.carpet(rng, height, width, PIXELS_PER_METRE * 1.6) * (1 + folds[..., None]))
    colour, other = random_colour(rng, 25, 210, 0.8), random_colour(rng, 25, 210, 0.8)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    stripes = np.sin(y * rng.uniform(0.08, 0.35)) + (np.sin(x * rng.uniform(0.08, 0.35)) if kind == 1 else 0)
    chosen = (stripes > 0.4)[..., None] & (kind != 3)
    return to_image(np.where(chosen, tint(other, folds), tint(colour, folds)))


def _shirt(rng: np.random.Generator, skin: Colour, height: int, width: int) -> Image:
    """Return a neck and a garment below it, with a print on the chest and one on the back, a collar and a belt."""
    image = _cloth(rng, height, width)
    for middle in (0.5, 0.02):
        rows, columns = int(rng.uniform(0.2, 0.32) * height), int(rng.uniform(0.12, 0.22) * width)
        top, left = int(0.25 * height), max(0, int(middle * width - columns / 2))
        if rng.random() < 0.7:
            image[top : top + rows, left : left + columns] = prints.picture(rng, rows, columns)
    image[: int(0.09 * height)] = random_colour(rng, 20, 230, 0.4)
    image[: int(0.07 * height)] = to_image(skin)
    image[int(0.78 * height) : int(0.82 * height)] = 30
    return image


def _trousers(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a leg of trousers with seams, and a shoe below."""
    colour = random_colour(rng, 25, 130, 0.7)
    folds = 0.16 * noise(rng, height, width, 0.15 * PIXELS_PER_METRE, 4) + 0.07 * noise(rng, height, width, 3, 2)
    image = to_image(tint(colour, folds))
    for share in (0.25, 0.75):
        cv2.line(image, (int(share * width), 0), (int(share * width), height), (0.5 * colour).tolist(), 2)
    image[int(0.83 * height) :] = random_colour(rng, 15, 200, 0.6)
    image[int(0.9 * height) :] = rng.choice([25, 220])
    return image


def _sleeve(shirt: Image, skin: Colour, share: float, height: int, width: int) -> Image:
    """Return the picture of an arm in a sleeve that covers a share of it."""
    cloth = shirt[int(0.55 * len(shirt)) : int(0.77 * len(shirt)), :width]
    image = np.ascontiguousarray(np.resize(cloth, (height, width, 3)))
    image[int(share * height) :] = to_image(skin)
    return image


def _head(rng: np.random.Generator, skin: Colour, height: int, width: int) -> Image:
    """Return a head from all sides: hair above and behind, a face in the middle of the picture."""
    canvas = to_image(tint(skin, 0.06 * noise(rng, height, width, 12, 3)))
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    across, down = np.abs(x / width - 0.5), y / height
    fringe = rng.uniform(0.24, 0.36)
    hair = (down < fringe + 0.03 * np.sin(x)) | ((across > rng.uniform(0.18, 0.24)) & (down < rng.uniform(0.55, 0.85)))
    shade = np.array([22.0, 30.0, 42.0]) + float(rng.choice([0.0, 0.2, 0.5, 1.0])) * np.array([85.0, 115.0, 130.0])
    strands = tint(shade, 0.3 * noise(rng, height, width, 5, 3))
    canvas = np.ascontiguousarray(np.where(hair[..., None], to_image(strands), canvas))
    for share in (0.42, 0.58):
        eye = (int(share * width), int(0.5 * height))
        cv2.ellipse(canvas, eye, (max(2, width // 32), max(1, height // 40)), 0, 0, 360, (235, 235, 235), -1)
        cv2.circle(canvas, eye, max(1, height // 45), (30, 30, 30), -1)
        brow = (eye[0], eye[1] - height // 14)
        cv2.ellipse(canvas, brow, (width // 26, 1), 0, 0, 360, (40, 40, 50), -1)
    middle = width // 2
    cv2.line(canvas, (middle, int(0.52 * height)), (middle, int(0.61 * height)), (0.7 * skin).tolist(), 2)
    cv2.ellipse(canvas, (middle, int(0.7 * height)), (width // 22, max(1, height // 50)), 0, 0, 360, (70, 60, 150), -1)
    return canvas


def _pixels(length_m: float) -> int:
    return max(16, round(length_m * PIXELS_PER_METRE))


def person(rng: np.random.Generator) -> Figure:
    """Return somebody drawn at random: 1.55 to 1.95 m tall, some with a bag on the back."""
    tall, shoulder = float(rng.uniform(1.58, 1.9)), float(rng.uniform(0.155, 0.205))
    belly = float(rng.uniform(0.1, 0.15))
    skin = np.array([60.0, 90.0, 140.0]) + rng.uniform(0, 1) * np.array([85.0, 90.0, 95.0])
    shirt = _shirt(rng, skin, _pixels(0.42 * tall), _pixels(2 * np.pi * 0.15))
    legs = _trousers(rng, _pixels(0.5 * tall), _pixels(0.45))
    sleeve = _sleeve(shirt, skin, float(rng.choice([0.35, 0.85])), _pixels(0.4 * tall), _pixels(0.3))
    meshes = [_torso(tall, shoulder, belly, shirt), _skull(tall, _head(rng, skin, _pixels(0.3), _pixels(0.5)))]
    if rng.random() < 0.5:
        meshes.append(_bag(rng, tall))
    parts = [Part(tuple(meshes), np.zeros(3))]
    for side in (1.0, -1.0):
        parts.append(Part((_leg(tall, legs),), np.array([0.0, side * 0.5 * shoulder, 0.48 * tall]), side))
    for side in (1.0, -1.0):
        joint = np.array([0.0, side * (shoulder + 0.03), 0.795 * tall])
        parts.append(Part((_arm(tall, side, sleeve),), joint, -0.8 * side))
    return Figure(tuple(parts), tall, 2 * (shoulder + 0.08))


def _torso(tall: float, shoulder: float, belly: float, image: Image) -> Mesh:
    rings: list[Ring] = [(0.87, 0, 0, 0.05, 0.05), (0.835, 0, 0, 0.06, 0.06), (0.822, 0, 0, 0.085, 0.62 * shoulder)]
    rings += [
        (0.80, 0, 0, 0.1, 0.94 * shoulder),
        (0.76, 0, 0, 0.115, shoulder),
        (0.68, 0.01, 0, belly, 0.94 * shoulder),
    ]
    rings += [(0.60, 0.01, 0, belly, 0.86 * shoulder), (0.53, 0, 0, 0.12, 0.93 * shoulder)]
    rings += [(0.47, 0, 0, 0.11, 0.88 * shoulder), (0.455, 0, 0, 0.01, 0.02)]
    return lofted(np.array(rings) * (tall, 1, 1, 1, 1), image)


def _skull(tall: float, image: Image) -> Mesh:
    down = np.linspace(0.03, np.pi - 0.03, 11)
    radius = np.sin(down) * np.where(down > np.pi / 2, 1 - 0.12 * (down - np.pi / 2), 1.0)
    z = 0.929 * tall + 0.071 * tall * np.cos(down)
    return lofted(np.stack([z, np.full(11, 0.015), np.zeros(11), 0.1 * radius, 0.078 * radius], axis=1), image)


def _leg(tall: float, image: Image) -> Mesh:
    rings: list[Ring] = [(0.02, 0, 0, 0.02, 0.02), (0.01, 0, 0, 0.085, 0.08), (-0.1, 0, 0, 0.085, 0.078)]
    rings += [(-0.23, 0.005, 0, 0.062, 0.058), (-0.3, 0, 0, 0.06, 0.054), (-0.41, 0, 0, 0.05, 0.048)]
    rings += [(-0.435, 0.01, 0, 0.065, 0.045), (-0.455, 0.045, 0, 0.115, 0.047), (-0.48, 0.05, 0, 0.125, 0.05)]
    rings += [(-0.4799, 0.05, 0, 0.01, 0.01)]
    return lofted(np.array(rings) * (tall, 1, 1, 1, 1), image)


def _arm(tall: float, side: float, image: Image) -> Mesh:
    rings: list[Ring] = [(0.012, 0, 0, 0.012, 0.012), (0.005, 0, 0.0, 0.05, 0.045), (-0.06, 0, 0.012, 0.052, 0.047)]
    rings += [(-0.18, 0, 0.03, 0.043, 0.04), (-0.3, 0.02, 0.035, 0.033, 0.03), (-0.34, 0.03, 0.035, 0.042, 0.022)]
    rings += [(-0.38, 0.035, 0.035, 0.035, 0.018), (-0.4, 0.035, 0.035, 0.005, 0.005)]
    return lofted(np.array(rings) * (tall, 1, side, 1, 1), image)


def _bag(rng: np.random.Generator, tall: float) -> Mesh:
    rings: list[Ring] = [(0.78, -0.17, 0, 0.01, 0.01), (0.775, -0.17, 0, 0.06, 0.12), (0.72, -0.18, 0, 0.09, 0.15)]
    rings += [(0.58, -0.18, 0, 0.095, 0.155), (0.55, -0.17, 0, 0.07, 0.14), (0.549, -0.17, 0, 0.01, 0.01)]
    return lofted(np.array(rings) * (tall, 1, 1, 1, 1), prints.carton(rng, _pixels(0.45), _pixels(0.8)))
