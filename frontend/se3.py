"""Rigid motions as (4, 4) matrices; the functions take stacks (..., 4, 4) where it says so."""

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

# Axes of a level camera (x right, y down, z forward) in a REP-103 world (x forward, y left, z up).
T_WORLD_LEVEL_CAM: Matrix = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
T_WORLD_LEVEL_CAM.setflags(write=False)

POLAR_ITERATIONS = 3  # from 1e-2 to 1e-15


def make(R: NDArray[np.floating], t: NDArray[np.floating]) -> Matrix:
    """Return the motion with rotation R (3, 3) and translation t (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.asarray(t).reshape(3)
    return T


def inverse(T: Matrix) -> Matrix:
    """Invert a stack (..., 4, 4) of rigid motions."""
    out = np.zeros_like(T)
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R_transposed
    out[..., :3, 3] = -(R_transposed @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def transform(T: Matrix, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Map (N, 3) points by T."""
    return np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]


def rotation_angle(R: Matrix) -> NDArray[np.float64]:
    """Return the angles (...) of a stack (..., 3, 3) of rotations, accurate for small ones too."""
    skew = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1)
    return np.arctan2(np.linalg.norm(skew, axis=-1), cosine)


def from_quaternion(xyzw: NDArray[np.floating]) -> Matrix:
    """Return the rotations (..., 3, 3) of quaternions (..., 4) in the order x y z w, which are normalised first."""
    q = np.asarray(xyzw, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_quaternion(R: Matrix) -> NDArray[np.float64]:
    """Return the quaternion (4,) x y z w with w >= 0 of one rotation (3, 3), by the largest-component method."""
    trace = np.trace(R)
    choices = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    k = int(np.argmax(choices))
    q = np.empty(4)
    if k == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + trace
    else:
        i, j, m = k, (k + 1) % 3, (k + 2) % 3
        q[i] = 1 - trace + 2 * R[i, i]
        q[j] = R[j, i] + R[i, j]
        q[m] = R[m, i] + R[i, m]
        q[3] = R[m, j] - R[j, m]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def hat(v: NDArray[np.floating]) -> Matrix:
    """Return the skew-symmetric matrix (3, 3) of v (3,)."""
    x, y, z = np.asarray(v, np.float64).reshape(3)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def exp_rotation(w: NDArray[np.floating]) -> Matrix:
    """Return the rotation (3, 3) about axis w by |w| radians (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    W = hat(w)
    if angle < 1e-8:
        return np.eye(3) + W + 0.5 * W @ W
    return np.eye(3) + np.sin(angle) / angle * W + (1 - np.cos(angle)) / angle**2 * W @ W


def log_rotation(R: Matrix) -> NDArray[np.float64]:
    """Return the rotation vector (3,) of R (3, 3)."""
    q = to_quaternion(R)
    norm = float(np.linalg.norm(q[:3]))
    if norm < 1e-12:
        return 2 * q[:3]
    return 2 * np.arctan2(norm, q[3]) / norm * q[:3]


def adjoint(T: Matrix) -> Matrix:
    """Return the (6, 6) adjoint of T, rotation first: a tangent vector of b, seen from a."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(t) @ R
    return out


def orthonormalise(T: Matrix) -> Matrix:
    """Return T (..., 4, 4) with its rotation replaced by the nearest proper one (long products drift from SO(3)).

    Newton's iteration for the polar factor (Higham 1986), which squares the error each time: for drift, not for
    matrices that are far from a rotation.
    """
    out = np.array(T, np.float64)
    R = out[..., :3, :3]
    for _ in range(POLAR_ITERATIONS):
        R[...] = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    return out
