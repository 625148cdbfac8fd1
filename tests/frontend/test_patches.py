"""Patch alignment against images that are warped by known maps."""

import cv2
import numpy as np
import pytest

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.patches import align_along, align_warped
from seamark.frontend.pyramid import pyramid_of
from seamark.frontend.tracker import patch_warps

RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(240, 320)).astype(np.float32)
TEXTURE = np.clip(128 + 260 * cv2.GaussianBlur(NOISE, (0, 0), 2.0), 0, 255).astype(np.uint8)
READY = pyramid_of(TEXTURE, 0)
POINTS = np.stack(np.meshgrid(np.arange(60, 260, 25.0), np.arange(60, 180, 25.0)), -1).reshape(-1, 2)


def warped(A: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the texture moved by x -> A (x - c) + c + t, and where the points go."""
    centre = np.array([160.0, 120.0])
    M = np.column_stack([A, centre - A @ centre + t])
    image = cv2.warpAffine(TEXTURE, M, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return image, POINTS @ A.T + M[:, 2]


@pytest.mark.parametrize(
    "A", [np.eye(2), 1.2 * np.eye(2), np.array([[0.97, -0.25], [0.25, 0.97]]), np.array([[1.1, 0.15], [-0.05, 0.9]])]
)
def test_points_are_found_under_a_known_warp(A: np.ndarray) -> None:
    """Test: starts are up to 1 px off, the light changes. Expected: 0.05 px; a wrong warp is worse."""
    image, true = warped(A, np.array([0.37, -0.61]))
    image = np.clip(image.astype(float) + 12, 0, 255).astype(np.uint8)
    start = true + RNG.uniform(-0.7, 0.7, true.shape)
    warps = np.tile(A, (len(POINTS), 1, 1))
    there, correlation = align_warped(READY, pyramid_of(image, 0), POINTS, start, warps)
    error = np.linalg.norm(there - true, axis=1)
    assert 0 < np.median(error) < 0.05
    assert np.mean(error < 0.15) > 0.9
    assert np.median(correlation) > 0.97
    if not np.allclose(A, np.eye(2)):
        plain, _ = align_warped(READY, pyramid_of(image, 0), POINTS, start, np.tile(np.eye(2), (len(POINTS), 1, 1)))
        assert np.median(np.linalg.norm(plain - true, axis=1)) > 1.5 * np.median(error)


def test_a_line_keeps_the_point_on_it() -> None:
    image, true = warped(np.eye(2), np.array([2.3, 0.0]))
    start = true + np.column_stack([RNG.uniform(-0.8, 0.8, len(true)), np.zeros(len(true))])
    along = np.tile([1.0, 0.0], (len(true), 1))
    there, correlation = align_along(READY, pyramid_of(image, 0), POINTS, start, along)
    np.testing.assert_allclose(there[:, 1], start[:, 1], atol=1e-4)
    assert np.median(np.abs(there[:, 0] - true[:, 0])) < 0.06  # OpenCV warps in steps of 1/32 px
    assert np.median(correlation) > 0.97


def test_nothing_and_nowhere() -> None:
    nothing = np.zeros((0, 2))
    assert len(align_warped(READY, READY, nothing, nothing, np.zeros((0, 2, 2)))[0]) == 0
    assert len(align_along(READY, READY, nothing, nothing, nothing)[0]) == 0
    flat = pyramid_of(np.full_like(TEXTURE, 90), 0)
    there, correlation = align_warped(flat, flat, POINTS, POINTS, np.tile(np.eye(2), (len(POINTS), 1, 1)))
    assert np.isfinite(there).all() and (correlation < 0.5).all()
    far = POINTS + 10_000
    assert np.isfinite(align_warped(READY, READY, far, far, np.tile(np.eye(2), (len(POINTS), 1, 1)))[0]).all()


def test_warps_are_those_of_a_plane_that_faces_the_reference() -> None:
    camera = Camera(640, 480, 400, 400, 320, 240)
    points = np.array([[0.0, 0.0, 4.0], [1.0, -0.5, 3.0], [0.0, 0.0, -2.0]])
    nearer = se3.inverse(se3.make(np.eye(3), np.array([0, 0, 1.0])))
    warps = patch_warps(nearer, points, camera)
    np.testing.assert_allclose(warps[0], 4 / 3 * np.eye(2), atol=1e-9)
    np.testing.assert_allclose(warps[1], 3 / 2 * np.eye(2), atol=1e-9)
    assert np.isnan(warps[2]).all()
    rolled = se3.make(se3.exp_rotation(np.array([0, 0, 0.3])), np.zeros(3))
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(patch_warps(rolled, points[:1], camera)[0], [[c, -s], [s, c]], atol=1e-9)
