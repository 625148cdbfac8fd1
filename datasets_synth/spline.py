"""Twice continuously differentiable curves: uniform B-splines to draw paths, interpolating splines to measure them.

C. de Boor, "A Practical Guide to Splines", 1978; unit quaternions are interpolated component by component and divided
by their norm, of which the angular velocity follows in closed form.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.frontend import se3

Array = NDArray[np.float64]
BASIS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6


@dataclass(frozen=True, eq=False)
class UniformSpline:
    """The cubic B-spline of ``control`` (N, D) points that are ``step`` apart in time, from 0 to ``duration``."""

    control: Array
    step: float

    @property
    def duration(self) -> float:
        """Return the time of the last control point."""
        return (len(self.control) - 1) * self.step

    def __call__(self, times: Array) -> Array:
        """Return the points (M, D) at ``times`` (M,), which are held within the curve."""
        padded = np.concatenate([self.control[:1], self.control, np.repeat(self.control[-1:], 2, axis=0)])
        place = np.clip(np.asarray(times, np.float64) / self.step, 0, len(self.control) - 1)
        k = np.minimum(place.astype(np.int64), len(self.control) - 1)
        f = place - k
        weights = np.stack([np.ones_like(f), f, f**2, f**3], axis=1) @ BASIS
        points: Array = np.einsum("mk,mkd->md", weights, padded[k[:, None] + np.arange(4)])
        return points


@dataclass(frozen=True, eq=False)
class CubicSpline:
    """The natural cubic spline through ``values`` (N, D) at ``knots`` (N,) s, which ascend; ``bends`` are the second
    derivatives (N, D) at the knots.
    """

    knots: Array
    values: Array
    bends: Array

    def __call__(self, times: Array, derivative: int = 0) -> Array:
        """Return the curve (M, D) at ``times`` (M,) or its first or second derivative."""
        k = np.clip(np.searchsorted(self.knots, times, "right") - 1, 0, len(self.knots) - 2)
        h = (self.knots[k + 1] - self.knots[k])[:, None]
        b = (times[:, None] - self.knots[k][:, None]) / h
        a = 1 - b
        y0, y1, m0, m1 = self.values[k], self.values[k + 1], self.bends[k], self.bends[k + 1]
        if derivative == 0:
            return a * y0 + b * y1 + ((a**3 - a) * m0 + (b**3 - b) * m1) * h**2 / 6
        if derivative == 1:
            return (y1 - y0) / h + ((3 * b**2 - 1) * m1 - (3 * a**2 - 1) * m0) * h / 6
        return a * m0 + b * m1


def through(knots: Array, values: Array) -> CubicSpline:
    """Return the natural cubic spline through ``values`` (N, D) at ``knots`` (N,); raises SeamarkError."""
    if len(knots) < 2 or np.any(np.diff(knots) <= 0):
        raise SeamarkError(f"a spline needs two knots at least, and ascending ones; there are {len(knots)}")
    h = np.diff(knots)
    slopes = np.diff(values, axis=0) / h[:, None]
    right = 6 * np.diff(slopes, axis=0)
    diagonal = 2 * (h[:-1] + h[1:])
    bends = np.zeros_like(values)
    for k in range(1, len(right)):  # the algorithm of Thomas: the matrix has three diagonals
        share = h[k] / diagonal[k - 1]
        diagonal[k] -= share * h[k]
        right[k] -= share * right[k - 1]
    for k in range(len(right) - 1, -1, -1):
        bends[k + 1] = (right[k] - h[k + 1] * bends[k + 2]) / diagonal[k]
    return CubicSpline(knots, values, bends)


@dataclass(frozen=True, eq=False)
class PoseSpline:
    """A smooth motion through poses: ``position`` is a spline in m, ``attitude`` one of quaternions x y z w."""

    position: CubicSpline
    attitude: CubicSpline

    def poses(self, times: Array) -> Array:
        """Return T_world_body (M, 4, 4) at ``times`` (M,) s."""
        out = np.tile(np.eye(4), (len(times), 1, 1))
        out[:, :3, :3] = se3.from_quaternion(self.attitude(times))
        out[:, :3, 3] = self.position(times)
        return out

    def angular_velocity(self, times: Array) -> Array:
        """Return the angular velocity (M, 3) rad/s in the frame of the body."""
        s = self.attitude(times)
        norm = np.linalg.norm(s, axis=1, keepdims=True)
        q, dq = s / norm, self.attitude(times, 1) / norm  # the part of dq along q drops out below
        v, w = q[:, :3], q[:, 3:]
        return 2 * (w * dq[:, :3] - dq[:, 3:] * v - np.cross(v, dq[:, :3]))


def through_poses(times: Array, T_world_body: Array) -> PoseSpline:
    """Return the smooth motion through T_world_body (N, 4, 4) at ``times`` (N,) s; raises SeamarkError."""
    q = np.stack([se3.to_quaternion(T[:3, :3]) for T in T_world_body])
    turned = np.sum(q[1:] * q[:-1], axis=1) < 0
    q[1:][np.cumsum(turned) % 2 == 1] *= -1  # of the two quaternions of a rotation the one nearer to the last
    return PoseSpline(through(times, T_world_body[:, :3, 3].copy()), through(times, q))
