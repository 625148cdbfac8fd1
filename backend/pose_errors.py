"""The errors of what two views have matched, and how they move with the pose between them.

A match gives up to three errors: where the landmark of one camera appears in the other (two), and how its depth there
compares with the depth that the other camera has measured (one). Each is weighed by the noise that caused it: of both
key points, and of inverse depth, along the line on which a wrong depth moves a point. What many of them have in common
no number of matches averages out: see :mod:`seamark.backend.shared_errors`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.shared_errors import cells_of, independent_share, measured_share
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]

CAUCHY_WIDTH = 2.5  # standard deviations
PRIOR_FREEDOM = 30.0
LEVERS = 8  # matches of most leverage among which the one that holds a pose most is sought
LEAST_INFORMATION = 1e-12  # of the most


@dataclass(frozen=True, eq=False)
class Observations:
    """M matches as two calibrated cameras see them.

    ``X_query X_match`` (M, 3) are the landmarks in their own camera, NaN where unknown, in one unit of length;
    ``uv_query uv_match`` (M, 2) are ideal pixels. ``sigma_query sigma_match`` (M,) are the standard deviations of
    inverse depth where they are known, NaN (or None for all) where a sensor has measured it: its noise shows between
    the views.
    """

    X_query: Matrix
    X_match: Matrix
    uv_query: Matrix
    uv_match: Matrix
    query: Camera
    match: Camera
    sigma_query: NDArray[np.float64] | None = None
    sigma_match: NDArray[np.float64] | None = None

    @property
    def measured(self) -> Flags:
        """Return of which matches (M,) no landmark's deviation is known beforehand."""
        known = np.zeros(len(self.uv_query), bool)
        for sigma in (self.sigma_query, self.sigma_match):
            known |= False if sigma is None else np.isfinite(sigma)
        return ~known

    def deviations(self, sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the standard deviations of inverse depth (M,) in query and match; ``sigma`` is that of the sensors."""
        everywhere = np.full(len(self.uv_query), sigma)
        in_query, in_match = (
            everywhere if one is None else np.where(np.isnan(one), sigma, one)
            for one in (self.sigma_query, self.sigma_match)
        )
        return in_query, in_match


@dataclass(frozen=True, eq=False)
class PoseSystem:
    """Whitened errors of matches near a pose, K in all.

    ``J`` (K, 6) is their Jacobian in the query's tangent space, rotation first, ``errors`` (K,) their values and
    ``owners`` (K,) the match that each belongs to. ``variance_scale`` is their variance per assumed one, ``share`` what
    part of it neighbours have in common.
    """

    J: Matrix
    errors: NDArray[np.float64]
    owners: NDArray[np.int64]
    variance_scale: float
    share: float

    def without_one(self, scaling: NDArray[np.float64]) -> Matrix:
        """Return the covariances (L, 6, 6) that are left when any one of the L matches of most leverage is not counted.

        A wrong match that fits by chance is found out by the others, unless it alone holds some direction of the pose.
        ``scaling`` (6,) makes radians and lengths comparable.
        """
        J = self.J * scaling
        information = J.T @ J
        leverage = np.einsum("ki,ij,kj->k", J, np.linalg.inv(information), J)
        levers = np.argsort(-np.bincount(self.owners, leverage), kind="stable")[:LEVERS]
        own = [J[self.owners == lever] for lever in levers]
        values, axes = np.linalg.eigh(np.stack([information - rows.T @ rows for rows in own]))
        values = np.maximum(values, LEAST_INFORMATION * values[:, -1:])
        left = (axes / values[:, None, :]) @ np.swapaxes(axes, 1, 2)
        return np.asarray(left * np.outer(scaling, scaling) * self.variance_scale)


def errors(T_match_query: Matrix, seen: Observations) -> NDArray[np.float64]:
    """Return reprojection errors (M,) in pixels, infinite without a landmark and behind a camera.

    The match's landmark is looked for in the query; where there is none, the query's in the match.
    """
    out = np.full(len(seen.uv_query), np.inf)
    for T, X, uv, camera in (
        (T_match_query, seen.X_query, seen.uv_match, seen.match),
        (se3.inverse(T_match_query), seen.X_match, seen.uv_query, seen.query),
    ):
        known = np.flatnonzero(np.isfinite(X).all(axis=1))
        p = se3.transform(T, X[known])
        ahead = p[:, 2] > 1e-9
        known = known[ahead]
        out[known] = np.linalg.norm(camera.project_ideal(p[ahead]) - uv[known], axis=1)
    return out


def linearise(T: Matrix, seen: Observations, inliers: Flags, sigma: float, config: VerificationConfig) -> PoseSystem:
    """Return the errors of the inliers at a pose; ``sigma`` is the standard deviation of the inverse depths that
    sensors measured.

    The assumed variance counts like PRIOR_FREEDOM errors: few matches cannot pretend to be better than is usual.
    """
    T_query_match = se3.inverse(T)
    in_query = inliers & np.isfinite(seen.X_match).all(axis=1)
    in_match = inliers & ~in_query
    both = in_query & np.isfinite(seen.X_query).all(axis=1)
    s_query, s_match = seen.deviations(sigma)
    X, p = seen.X_match[in_query], se3.transform(T_query_match, seen.X_match[in_query])
    motion = np.concatenate([_hats(p), np.broadcast_to(-np.eye(3), (len(p), 3, 3))], axis=2)
    parts = [
        _pixels(
            X,
            p,
            T_query_match[:3, :3],
            motion,
            seen.uv_query[in_query],
            seen.query,
            seen.match,
            s_match[in_query],
            config,
        )
    ]
    Y, q = seen.X_query[in_match], se3.transform(T, seen.X_query[in_match])
    motion = T[:3, :3] @ np.concatenate([-_hats(Y), np.broadcast_to(np.eye(3), (len(q), 3, 3))], axis=2)
    parts.append(
        _pixels(Y, q, T[:3, :3], motion, seen.uv_match[in_match], seen.match, seen.query, s_query[in_match], config)
    )
    X, Y, p = seen.X_match[both], seen.X_query[both], se3.transform(T_query_match, seen.X_match[both])
    J = (
        -np.concatenate([_hats(p), np.broadcast_to(-np.eye(3), (len(p), 3, 3))], axis=2)[:, 2:]
        / p[:, 2, None, None] ** 2
    )
    deviation = np.sqrt(s_query[both] ** 2 + s_match[both] ** 2 * (X[:, 2] / p[:, 2]) ** 4)
    parts.append((J / deviation[:, None, None], ((1 / p[:, 2] - 1 / Y[:, 2]) / deviation)[:, None]))
    cells = [cells_of(seen.uv_query[in_query], seen.query), cells_of(seen.uv_match[in_match], seen.match)]
    cells.append(cells_of(seen.uv_query[both], seen.query))
    weights = [1 / (1 + (r**2).sum(axis=1) / CAUCHY_WIDTH**2) for _, r in parts]
    pixels = [(r * np.sqrt(w)[:, None], w, c) for (_, r), w, c in zip(parts[:2], weights, cells, strict=False)]
    shares = [measured_share(pixels, config.shared_share)] * 2 + [config.shared_depth**2]
    return _stacked(parts, weights, cells, shares, [np.flatnonzero(part) for part in (in_query, in_match, both)])


def _stacked(
    parts: Sequence[tuple[Matrix, Matrix]],
    weights: Sequence[NDArray[np.float64]],
    cells: Sequence[NDArray[np.int64]],
    shares: Sequence[float],
    matches: Sequence[NDArray[np.int64]],
) -> PoseSystem:
    """Return all kinds of errors as one system, each weighed by its trust and by what its cell leaves as news."""
    J_all, r_all, owners = [], [], []
    squared, freedom = 0.0, -6.0
    for (J, r), robust, cell, share, match in zip(parts, weights, cells, shares, matches, strict=True):
        squared += float((robust[:, None] * r**2).sum())
        freedom += float(robust.sum()) * r.shape[1]
        weight = np.sqrt(robust * independent_share(cell, share))
        J_all.append((weight[:, None, None] * J).reshape(-1, 6))
        r_all.append((weight[:, None] * r).reshape(-1))
        owners.append(np.repeat(match, r.shape[1]))
    variance_scale = (PRIOR_FREEDOM + squared) / (PRIOR_FREEDOM + max(freedom, 0.0))
    return PoseSystem(np.concatenate(J_all), np.concatenate(r_all), np.concatenate(owners), variance_scale, shares[0])


def _pixels(
    X: Matrix,
    p: Matrix,
    R: Matrix,
    motion: Matrix,
    uv: Matrix,
    camera: Camera,
    other: Camera,
    sigma: NDArray[np.float64],
    config: VerificationConfig,
) -> tuple[Matrix, Matrix]:
    """Return whitened Jacobians (K, 2, 6) and errors (K, 2).

    ``X`` (K, 3) are landmarks in the other camera's frame, ``p`` in this one's, ``motion`` (K, 3, 6) is of p, ``sigma``
    (K,) the standard deviation of inverse depth.
    """
    focal = np.array([camera.fx, camera.fy])
    projection = np.zeros((len(p), 2, 3))
    projection[:, 0, 0], projection[:, 1, 1] = (focal / p[:, 2:]).T
    projection[:, :, 2] = -focal * p[:, :2] / p[:, 2:] ** 2
    residual = camera.project_ideal(p) - uv
    magnification = X[:, 2] / p[:, 2] * camera.fx / other.fx
    own = config.noise_px**2 * (1 + magnification**2)
    along = (projection @ (R @ (X * X[:, 2:]).T).T[:, :, None])[:, :, 0]  # by an error of inverse depth
    length = np.linalg.norm(along, axis=1)
    unit = along / np.maximum(length, 1e-12)[:, None]
    across = 1 / np.sqrt(own)
    gain = 1 / np.sqrt(own + (sigma * length) ** 2) - across
    whitening = across[:, None, None] * np.eye(2) + gain[:, None, None] * unit[:, :, None] * unit[:, None, :]
    return whitening @ projection @ motion, (whitening @ residual[:, :, None])[:, :, 0]


def _hats(v: Matrix) -> Matrix:
    """Return the skew-symmetric matrices (N, 3, 3) of v (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out
