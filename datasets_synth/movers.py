"""People who walk about in front of the camera: textured boxes, and where each of them is at every frame."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import prints, textures
from seamark.datasets_synth.panels import Panel, box_faces
from seamark.datasets_synth.textures import Image, noise, random_colour, tint, to_image

PIXELS_PER_METRE = 160.0
ENCOUNTER_S = (2.5, 6.0)  # how long one of them is about
PAUSE_S = (0.3, 2.5)
WALKING_M_S = (0.8, 1.5)
NEAREST_M = 0.75  # that anybody comes to the camera


def _cloth(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return a checked, striped or plain garment, perhaps with a print on it."""
    kind = int(rng.integers(3))
    if kind == 0:
        image = textures.carpet(rng, height, width, PIXELS_PER_METRE * 2)
    else:
        colour, other = random_colour(rng, 25, 210, 1.2), random_colour(rng, 25, 210, 1.2)
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        stripes = np.sin(y * rng.uniform(0.15, 0.6)) + (np.sin(x * rng.uniform(0.15, 0.6)) if kind == 1 else 0)
        folds = 0.18 * noise(rng, height, width, 0.3 * PIXELS_PER_METRE, 4)
        image = to_image(np.where((stripes > 0.4)[..., None], tint(colour, folds), tint(other, folds)))
    return prints.add_stickers(rng, image, PIXELS_PER_METRE, 25.0)


def _skin_and_hair(rng: np.random.Generator, height: int, width: int) -> Image:
    """Return the side of a head: hair above, a face or a neck below."""
    skin = np.array([rng.uniform(60, 150), rng.uniform(80, 180), rng.uniform(120, 230)])
    canvas = to_image(tint(skin, 0.08 * noise(rng, height, width, 10, 3)))
    hair = int(rng.uniform(0.3, 0.7) * height)
    canvas[:hair] = to_image(tint(random_colour(rng, 15, 110, 0.5), 0.4 * noise(rng, hair, width, 6, 3)))
    for share in (0.3, 0.7):
        row, column = min(height - 4, int(0.6 * height)), int(share * width)
        canvas[row : row + 3, column - 2 : column + 3] = 25
    return canvas


def person(rng: np.random.Generator) -> list[Panel]:
    """Return somebody standing at the origin and facing x: legs, body, head, a bag for some."""
    tall = rng.uniform(1.6, 1.92)
    wide = rng.uniform(0.42, 0.58)
    parts = [
        (np.array([0.0, 0.0, 0.24 * tall]), np.array([0.22, 0.75 * wide, 0.48 * tall]), _cloth),
        (np.array([0.0, 0.0, 0.66 * tall]), np.array([0.28, wide, 0.36 * tall]), _cloth),
        (np.array([0.0, 0.0, 0.92 * tall]), np.array([0.2, 0.17, 0.16 * tall]), _skin_and_hair),
    ]
    if rng.random() < 0.6:
        parts.append((np.array([-0.2, 0.0, 0.7 * tall]), np.array([0.16, 0.32, 0.42]), prints.carton))
    panels = []
    for centre, size, maker in parts:
        for corner, right, down in box_faces(centre, size):
            shape = [max(12, round(float(np.linalg.norm(edge)) * PIXELS_PER_METRE)) for edge in (down, right)]
            panels.append(Panel(corner, right, down, maker(rng, *shape)))
    return panels


# seconds since the middle of an encounter, length of the camera's way now, and then -> length and m to the left of it
Course = Callable[[float, float, float], tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Track:
    """Where somebody is at every frame: ``position`` (N, 3) m on the floor, ``yaw`` (N,), ``present`` (N,) bool."""

    position: NDArray[np.float64]
    yaw: NDArray[np.float64]
    present: NDArray[np.bool_]


class _Path:
    """The way of the camera over the floor by its length, going straight on before and beyond its ends."""

    def __init__(self, T_world_cam: NDArray[np.float64]) -> None:
        self.place = T_world_cam[:, :2, 3]
        looking = T_world_cam[:, :2, 2]
        self.looking = looking / np.maximum(np.linalg.norm(looking, axis=1, keepdims=True), 1e-9)
        self.length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.place, axis=0), axis=1))])

    def at(self, s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the place (2,) and the unit direction (2,) at length ``s``."""
        clipped = float(np.clip(s, 0, self.length[-1]))
        columns = (*self.place.T, *self.looking.T)
        x, y, right, up = (float(np.interp(clipped, self.length, column)) for column in columns)
        direction = np.array([right, up])
        direction = direction / max(1e-9, float(np.linalg.norm(direction)))
        return np.array([x, y]) + (s - clipped) * direction, direction


def track(T_world_cam: NDArray[np.float64], fps: float, clearance_m: float, rng: np.random.Generator) -> Track:
    """Return one person's walk along the way of the camera: towards it and past it, or ahead of it and weaving."""
    count = len(T_world_cam)
    path = _Path(T_world_cam)
    position, yaw, present = np.zeros((count, 3)), np.zeros(count), np.zeros(count, bool)
    frame = int(rng.uniform(0, ENCOUNTER_S[0]) * fps)
    while frame < count:
        length = max(2, int(rng.uniform(*ENCOUNTER_S) * fps))
        ahead = _oncoming(path, rng, clearance_m) if rng.random() < 0.5 else _weaving(rng, clearance_m)
        middle = min(count - 1, frame + length // 2)
        for index in range(frame, min(count, frame + length)):
            s, aside = ahead((index - middle) / fps, float(path.length[index]), float(path.length[middle]))
            place, direction = path.at(s)
            place = place + aside * np.array([-direction[1], direction[0]])
            position[index, :2] = place
            near = float(np.linalg.norm(place - path.place[index]))
            present[index] = near >= NEAREST_M * min(1.0, clearance_m / 0.6)
        frame += length + int(rng.uniform(*PAUSE_S) * fps)
    motion = np.gradient(position[:, :2], axis=0) if count > 1 else np.zeros((count, 2))
    yaw = np.arctan2(motion[:, 1], motion[:, 0])
    return Track(position, yaw, present)


def _oncoming(path: _Path, rng: np.random.Generator, clearance_m: float) -> Course:
    speed, side = rng.uniform(*WALKING_M_S), rng.choice([-1.0, 1.0])
    aside = side * min(rng.uniform(0.55, 0.9), max(0.45, clearance_m))
    return lambda t, _, meeting: (meeting - speed * t, aside)


def _weaving(rng: np.random.Generator, clearance_m: float) -> Course:
    distance, period, phase = rng.uniform(1.2, 2.6), rng.uniform(3.0, 6.0), rng.uniform(0, 2 * np.pi)
    reach = min(1.2, 0.7 * clearance_m)
    return lambda t, now, _: (
        now + distance + 0.2 * float(np.sin(1.3 * t)),
        reach * float(np.sin(2 * np.pi * t / period + phase)),
    )
