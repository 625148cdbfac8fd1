"""A world of random points seen by pinhole cameras, independent of the code under test."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth
from seamark.frontend.types import Features, Keyframe

IDEAL = Camera(640, 480, 500.0, 505.0, 320.0, 240.0)
DISTORTED = Camera(640, 480, 500.0, 505.0, 320.0, 240.0, (-0.25, 0.08, 0.001, -0.0005))


def pinhole(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project by the textbook's formulas (Brown-Conrady), not by the code under test."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if camera.distortion:
        k1, k2, p1, p2 = camera.distortion
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.column_stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy])


def rotation(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation by the matrix exponential's series."""
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    out, term = np.eye(3), np.eye(3)
    for k in range(1, 30):
        term = term @ W / k
        out = out + term
    return out


def motion(w: tuple[float, float, float], t: tuple[float, float, float]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = rotation(np.array(w, float))
    T[:3, 3] = t
    return T


@dataclass
class World:
    """Points with one random RootSIFT-like descriptor each."""

    points: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    rng: np.random.Generator

    def view(
        self,
        T_world_cam: NDArray[np.float64],
        camera: Camera | None = IDEAL,
        noise_px: float = 0.5,
        depth_noise: float = 0.0,
        outliers: float = 0.0,
        clutter: int = 100,
        unit: float = 1.0,
        depth: bool = True,
        **fields: object,
    ) -> Keyframe:
        """Look from a pose: shared points with noise, some of them displaced, and points that nobody else sees.

        ``unit`` is world lengths per unit of the landmarks.
        """
        rng, lens = self.rng, camera or IDEAL
        R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
        X = (self.points - t) @ R
        ahead = np.flatnonzero(X[:, 2] > 0.5)
        seen = pinhole(lens, X[ahead])
        # The polynomial folds far outside of the image: keep what the ideal camera sees near it.
        narrow = np.abs(X[ahead, :2] / X[ahead, 2:]).max(axis=1) < 0.8
        inside = (seen >= 0).all(axis=1) & (seen < (lens.width, lens.height)).all(axis=1) & narrow
        ids, pixels = ahead[inside], seen[inside]
        X_seen = X[ids] * (1 + depth_noise * rng.normal(size=(len(ids), 1)))
        pixels = pixels + noise_px * rng.normal(size=pixels.shape)
        wrong = rng.random(len(ids)) < outliers
        pixels[wrong] = rng.uniform((0, 0), (lens.width, lens.height), (int(wrong.sum()), 2))
        X_seen[wrong] = rng.uniform((-2, -2, 2), (2, 2, 8), (int(wrong.sum()), 3))
        points = np.vstack([pixels, rng.uniform((0, 0), (lens.width, lens.height), (clutter, 2))])
        descriptors = np.vstack([self.descriptors[ids], descriptors_of(rng, clutter)])
        landmarks = np.vstack([X_seen / unit, rng.uniform((-2, -2, 2), (2, 2, 8), (clutter, 3)) / unit])
        order = rng.permutation(len(points))
        count = len(points)
        features = Features(
            points[order].astype(np.float32),
            np.full(count, 8, np.float32),
            np.zeros(count, np.float32),
            descriptors[order],
        )
        values = {"id": 0, "session": 0, "index": 0, "stamp_ns": 0, "file": "view.png"} | fields
        return Keyframe(
            features=features,
            landmarks=landmarks[order].astype(np.float32) if depth else np.full((count, 3), np.nan, np.float32),
            thumbnail=np.zeros((2, 2), np.uint8),
            jpeg=b"jpeg",
            camera=camera,
            **values,  # type: ignore[arg-type]
        )


def descriptors_of(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    """Return random descriptors with the length that RootSIFT in uint8 has."""
    raw = rng.gamma(0.6, 1.0, (count, 128))
    return np.round(255 * np.sqrt(raw / raw.sum(axis=1, keepdims=True)).clip(0, 1)).astype(np.uint8)


def make_world(
    seed: int, count: int = 1500, low: float = -4, high: float = 4, near: float = 3, far: float = 9
) -> World:
    rng = np.random.default_rng(seed)
    points = rng.uniform((low, low, near), (high, high, far), (count, 3))
    return World(points, descriptors_of(rng, count), rng)


@pytest.fixture(scope="session")
def world() -> Callable[..., World]:
    return make_world


@pytest.fixture(scope="session")
def move() -> Callable[..., NDArray[np.float64]]:
    return motion


@pytest.fixture(scope="session")
def ideal() -> Camera:
    return IDEAL


@pytest.fixture(scope="session")
def distorted() -> Camera:
    return DISTORTED


@pytest.fixture(scope="session")
def make_keyframe() -> Callable[[int], Keyframe]:
    """Return a maker of keyframes whose every field is something, by their number."""

    def make(number: int) -> Keyframe:
        w = make_world(number, 200)
        keyframe = w.view(
            np.eye(4),
            DISTORTED,
            id=number,
            session=1,
            index=3 * number,
            stamp_ns=1403715273262142976 + number,
            file=f"cam0/{number}.png",
            previous_id=number - 1 if number else None,
            T_odom_cam=np.linalg.qr(w.rng.normal(size=(4, 4)))[0],
            covariance=np.diag(w.rng.random(6)),
        )
        depth = w.rng.uniform(1, 3, (48, 64)).astype(np.float32)
        return replace(keyframe, depth=encode_depth(depth, 1.0, FrontendConfig(keyframe_depth_px=160)))

    return make
