"""Where people walk: tracks over the floor, and the simple ones that come towards the camera or walk ahead of it."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

ENCOUNTER_S = (2.5, 6.0)  # how long one of them is about
PAUSE_S = (0.3, 2.5)
WALKING_M_S = (0.8, 1.5)
NEAREST_M = 0.75  # that anybody comes to the camera
STRIDE_M = 1.4  # of two steps
TURNING_S = 0.25  # sigma of the Gaussian that smooths where somebody faces
STANDING_M_S = 0.15  # slower than that nobody turns to where they go

Array = NDArray[np.float64]
# seconds since the middle of an encounter, length of the camera's way now, and then -> length and m to the left of it
Course = Callable[[float, float, float], tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Track:
    """Where somebody is at every frame: ``position`` (N, 3) m on the floor, ``yaw`` (N,), ``present`` (N,) bool.

    ``phase`` (N,) rad is that of the stride, ``pace`` (N,) the speed in m/s.
    """

    position: Array
    yaw: Array
    present: NDArray[np.bool_]
    phase: Array
    pace: Array


class Way:
    """The way of the camera over the floor by its length, going straight on before and beyond its ends."""

    def __init__(self, T_world_cam: Array) -> None:
        self.place = T_world_cam[:, :2, 3]
        looking = T_world_cam[:, :2, 2]
        self.looking = looking / np.maximum(np.linalg.norm(looking, axis=1, keepdims=True), 1e-9)
        self.length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self.place, axis=0), axis=1))])

    def at(self, s: Array, aside: Array) -> Array:
        """Return the places (M, 2) at lengths ``s`` (M,), moved to the left by ``aside`` (M,) m."""
        clipped = np.clip(s, 0, self.length[-1])
        columns = (*self.place.T, *self.looking.T)
        x, y, ahead_x, ahead_y = (np.interp(clipped, self.length, column) for column in columns)
        ahead = np.stack([ahead_x, ahead_y], axis=1)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        return np.asarray(np.stack([x, y], axis=1) + (s - clipped)[:, None] * ahead + aside[:, None] * left)


def smoothed(values: Array, sigma: float) -> Array:
    """Return values (N, D) smoothed along their first axis by a Gaussian of ``sigma`` samples, held at both ends."""
    reach = max(1, int(3 * sigma))
    kernel = cv2.getGaussianKernel(2 * reach + 1, max(sigma, 1e-3)).ravel()
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)


def make_track(position: Array, present: NDArray[np.bool_], fps: float) -> Track:
    """Return the track of somebody at ``position`` (N, 2) wherever they are ``present`` (N,): facing where they go."""
    count = len(position)
    yaw, phase, pace = np.zeros(count), np.zeros(count), np.zeros(count)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2):
        if end - begin < 2:
            continue
        velocity = smoothed(np.gradient(position[begin:end], axis=0) * fps, TURNING_S * fps)
        speed = np.linalg.norm(velocity, axis=1)
        moving = speed > STANDING_M_S
        last = np.maximum.accumulate(np.where(moving, np.arange(end - begin), -1))
        last[last < 0] = int(np.argmax(moving))
        heading = np.unwrap(np.arctan2(velocity[last, 1], velocity[last, 0]))
        yaw[begin:end] = smoothed(heading[:, None], TURNING_S * fps)[:, 0]
        phase[begin:end] = 2 * np.pi / STRIDE_M * np.cumsum(speed) / fps
        pace[begin:end] = speed
    return Track(np.column_stack([position, np.zeros(count)]), yaw, present, phase, pace)


def track(T_world_cam: Array, fps: float, clearance_m: float, rng: np.random.Generator) -> Track:
    """Return one person's walk along the way of the camera: towards it and past it, or ahead of it and weaving."""
    count = len(T_world_cam)
    way = Way(T_world_cam)
    position, present = np.zeros((count, 2)), np.zeros(count, bool)
    frame = int(rng.uniform(0, ENCOUNTER_S[0]) * fps)
    while frame < count:
        length = max(2, int(rng.uniform(*ENCOUNTER_S) * fps))
        ahead = _oncoming(rng, clearance_m) if rng.random() < 0.5 else _weaving(rng, clearance_m)
        middle = min(count - 1, frame + length // 2)
        for index in range(frame, min(count, frame + length)):
            s, aside = ahead((index - middle) / fps, float(way.length[index]), float(way.length[middle]))
            position[index] = way.at(np.array([s]), np.array([aside]))[0]
            near = float(np.linalg.norm(position[index] - way.place[index]))
            present[index] = near >= NEAREST_M * min(1.0, clearance_m / 0.6)
        frame += length + int(rng.uniform(*PAUSE_S) * fps)
    return make_track(position, present, fps)


def _oncoming(rng: np.random.Generator, clearance_m: float) -> Course:
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
