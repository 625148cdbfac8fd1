"""The most probable pose between two cameras from all that their matches say, and an honest covariance of it.

A match gives up to three errors: where the landmark of one camera appears in the other (two), and how its depth there
compares with the depth that the other camera has measured (one). Each is weighed by the noise that caused it: of both
key points, and of inverse depth, along the line on which a wrong depth moves a point. What many of them have in common
no number of matches averages out: see :mod:`seamark.backend.shared_errors`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.shared_errors import cells_of, excess_angle, independent_share, measured_share, systematic
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]

STEPS = 12
CAUCHY_WIDTH = 2.5  # standard deviations
PRIOR_FREEDOM = 30.0
CONVERGED = 1e-6
DEPTH_PAIRS = 10  # matches with both depths from which their noise is measured
DEPTH_OUTLIER = 4.0  # standard deviations
NEAREST = 0.05  # of the median depth: nothing is nearer


@dataclass(frozen=True, eq=False)
class Observations:
    """M matches as two calibrated cameras see them.

    ``X_query X_match`` (M, 3) are the landmarks in their own camera, NaN where unknown, in one unit of length;
    ``uv_query uv_match`` (M, 2) are ideal pixels.
    """

    X_query: Matrix
    X_match: Matrix
    uv_query: Matrix
    uv_match: Matrix
    query: Camera
    match: Camera


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """``T_match_query`` with its ``covariance`` (6, 6) in the query's tangent space, and what it rests on.

    ``inliers`` (M,) of all matches, ``reprojection_px`` their median error, ``depth_pairs`` how many inliers have a
    depth on both sides, ``depth_sigma`` the noise of inverse depth that was assumed or measured, ``depth`` the median
    depth of the inliers.
    """

    T_match_query: Matrix
    covariance: Matrix
    inliers: Flags
    reprojection_px: float
    depth_pairs: int
    depth_sigma: float
    depth: float


def refine(T_match_query: Matrix, seen: Observations, config: VerificationConfig) -> RefinedPose | None:
    """Return the pose of least weighed errors near ``T_match_query``; None where too little holds it.

    Gauss-Newton with Cauchy's weights; which matches belong to it is decided anew at each step.
    """
    T = T_match_query
    sigma = depth_sigma(T, seen, errors(T, seen) < config.reprojection_px)
    for _ in range(STEPS):
        inliers = _inliers(T, seen, sigma, config)
        if inliers.sum() < 6:
            return None
        J, r, _, _ = _system(T, seen, inliers, sigma, config)
        information = J.T @ J
        scaling = _scaling(T, seen, inliers)
        if not _well_conditioned(information, scaling):
            return None
        step = scaling * np.linalg.solve(information * np.outer(scaling, scaling), -scaling * (J.T @ r))
        T = T @ se3.make(se3.exp_rotation(step[:3]), step[3:])
        sigma = depth_sigma(T, seen, inliers)
        if np.abs(step / scaling).max() < CONVERGED:
            break
    inliers = _inliers(T, seen, sigma, config)
    if inliers.sum() < 6:
        return None
    J, r, variance_scale, share = _system(T, seen, inliers, sigma, config)
    information, scaling = J.T @ J, _scaling(T, seen, inliers)
    if not _well_conditioned(information, scaling):
        return None
    covariance = scaling[:, None] * np.linalg.inv(information * np.outer(scaling, scaling)) * scaling * variance_scale
    depth = float(scaling[3])
    angle = excess_angle(variance_scale, share, seen.query.fx, config)
    covariance += np.diag(systematic(T, depth, sigma * depth, angle, config) ** 2)
    both = np.isfinite(seen.X_query).all(axis=1) & np.isfinite(seen.X_match).all(axis=1)
    middle = float(np.median(errors(T, seen)[inliers]))
    covariance = 0.5 * (covariance + covariance.T)
    return RefinedPose(T, covariance, inliers, middle, int((both & inliers).sum()), sigma, depth)


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


def explained_without_depth(T_match_query: Matrix, seen: Observations, limit_px: float) -> tuple[Flags, Flags]:
    """Return which matches (M,) without a landmark on either side some depth explains, and which have none.

    A pose that a repeated pattern nearby has brought forth leaves what stands farther away unexplained.
    """
    known = np.isfinite(seen.X_query).all(axis=1) | np.isfinite(seen.X_match).all(axis=1)
    without: Flags = np.asarray(~known)
    R, t = T_match_query[:3, :3], T_match_query[:3, 3]
    near = np.concatenate([X[np.isfinite(X[:, 2]), 2] for X in (seen.X_query, seen.X_match)])
    closest = NEAREST * float(np.median(near)) if len(near) else 1.0
    rays = [
        np.column_stack([(uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(uv))])
        for uv, camera in ((seen.uv_query, seen.query), (seen.uv_match, seen.match))
    ]
    # R ray + t / z lies on the match's ray; the cross product with that leaves a + b / z = 0.
    turned = rays[0] @ R.T
    a, b = np.cross(rays[1], turned), np.cross(rays[1], t[None])
    inverse = np.clip(-(a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-18), 0, 1 / closest)
    p = turned + t * inverse[:, None]
    ahead = p[:, 2] > 1e-6
    p[~ahead] = (0, 0, 1)
    error = np.linalg.norm(seen.match.project_ideal(p) - seen.uv_match, axis=1)
    return np.asarray(without & ahead & (error < limit_px)), without


def depth_sigma(T_match_query: Matrix, seen: Observations, inliers: Flags) -> float:
    """Return the standard deviation of inverse depth, measured between both sides, or 3 per cent where it cannot be."""
    X_match, X_query = seen.X_match[inliers], seen.X_query[inliers]
    both = np.isfinite(X_match).all(axis=1) & np.isfinite(X_query).all(axis=1)
    z = np.concatenate([X_match[:, 2][np.isfinite(X_match[:, 2])], X_query[:, 2][np.isfinite(X_query[:, 2])]])
    middle = 1.0 / float(np.median(z)) if len(z) else 1.0
    p = se3.transform(se3.inverse(T_match_query), X_match[both])[:, 2]
    ahead = p > 1e-9
    if ahead.sum() < DEPTH_PAIRS:
        return 0.03 * middle
    p, z_query, z_match = p[ahead], X_query[both][ahead, 2], X_match[both][ahead, 2]
    difference = (1 / p - 1 / z_query) / np.sqrt(1 + (z_match / p) ** 4)
    return max(1.4826 * float(np.median(np.abs(difference))), 1e-3 * middle)


def _inliers(T: Matrix, seen: Observations, sigma: float, config: VerificationConfig) -> Flags:
    """Return which matches (M,) appear where they should and, where both depths are known, at the right depth."""
    inliers: Flags = errors(T, seen) < config.reprojection_px
    p = se3.transform(se3.inverse(T), seen.X_match)[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sqrt(1 + (seen.X_match[:, 2] / p) ** 4)
        far = np.abs(1 / p - 1 / seen.X_query[:, 2]) > DEPTH_OUTLIER * np.maximum(sigma * spread, 0.02 / p)
    return np.asarray(inliers & ~far)


def _system(
    T: Matrix, seen: Observations, inliers: Flags, sigma: float, config: VerificationConfig
) -> tuple[Matrix, NDArray[np.float64], float, float]:
    """Return the whitened Jacobian (K, 6) and errors (K,) of the inliers, their variance per assumed one and what
    share of it neighbours have in common.

    The assumed variance counts like PRIOR_FREEDOM errors: few matches cannot pretend to be better than is usual.
    """
    T_query_match = se3.inverse(T)
    in_query = inliers & np.isfinite(seen.X_match).all(axis=1)
    in_match = inliers & ~in_query
    both = in_query & np.isfinite(seen.X_query).all(axis=1)
    X, p = seen.X_match[in_query], se3.transform(T_query_match, seen.X_match[in_query])
    motion = np.concatenate([_hats(p), np.broadcast_to(-np.eye(3), (len(p), 3, 3))], axis=2)
    parts = [
        _pixels(X, p, T_query_match[:3, :3], motion, seen.uv_query[in_query], seen.query, seen.match, sigma, config)
    ]
    Y, q = seen.X_query[in_match], se3.transform(T, seen.X_query[in_match])
    motion = T[:3, :3] @ np.concatenate([-_hats(Y), np.broadcast_to(np.eye(3), (len(q), 3, 3))], axis=2)
    parts.append(_pixels(Y, q, T[:3, :3], motion, seen.uv_match[in_match], seen.match, seen.query, sigma, config))
    X, Y, p = seen.X_match[both], seen.X_query[both], se3.transform(T_query_match, seen.X_match[both])
    J = (
        -np.concatenate([_hats(p), np.broadcast_to(-np.eye(3), (len(p), 3, 3))], axis=2)[:, 2:]
        / p[:, 2, None, None] ** 2
    )
    deviation = sigma * np.sqrt(1 + (X[:, 2] / p[:, 2]) ** 4)
    parts.append((J / deviation[:, None, None], ((1 / p[:, 2] - 1 / Y[:, 2]) / deviation)[:, None]))
    cells = [cells_of(seen.uv_query[in_query], seen.query), cells_of(seen.uv_match[in_match], seen.match)]
    cells.append(cells_of(seen.uv_query[both], seen.query))
    weights = [1 / (1 + (r**2).sum(axis=1) / CAUCHY_WIDTH**2) for _, r in parts]
    pixels = [(r * np.sqrt(w)[:, None], w, c) for (_, r), w, c in zip(parts[:2], weights, cells, strict=False)]
    shares = [measured_share(pixels, config.shared_share)] * 2 + [config.shared_depth**2]
    J_all, r_all = [], []
    squared, freedom = 0.0, -6.0
    for (J, r), robust, cell, share in zip(parts, weights, cells, shares, strict=True):
        squared += float((robust[:, None] * r**2).sum())
        freedom += float(robust.sum()) * r.shape[1]
        weight = np.sqrt(robust * independent_share(cell, share))
        J_all.append((weight[:, None, None] * J).reshape(-1, 6))
        r_all.append((weight[:, None] * r).reshape(-1))
    variance_scale = (PRIOR_FREEDOM + squared) / (PRIOR_FREEDOM + max(freedom, 0.0))
    return np.concatenate(J_all), np.concatenate(r_all), variance_scale, shares[0]


def _pixels(
    X: Matrix,
    p: Matrix,
    R: Matrix,
    motion: Matrix,
    uv: Matrix,
    camera: Camera,
    other: Camera,
    sigma: float,
    config: VerificationConfig,
) -> tuple[Matrix, Matrix]:
    """Return whitened Jacobians (K, 2, 6) and errors (K, 2).

    ``X`` (K, 3) are landmarks in the other camera's frame, ``p`` in this one's, ``motion`` (K, 3, 6) is of p.
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


def _scaling(T: Matrix, seen: Observations, inliers: Flags) -> NDArray[np.float64]:
    """Return what makes radians and lengths comparable: (1, 1, 1, depth, depth, depth), depth that of the scene."""
    p = se3.transform(se3.inverse(T), seen.X_match[inliers])[:, 2]
    z = np.where(np.isfinite(p), p, seen.X_query[inliers, 2])
    depth = float(np.median(z))
    return np.array([1, 1, 1, depth, depth, depth])


def _well_conditioned(information: Matrix, scaling: NDArray[np.float64]) -> bool:
    scaled = information * np.outer(scaling, scaling)
    return bool(np.isfinite(scaled).all() and np.linalg.cond(scaled) < 1e9)


def _hats(v: Matrix) -> Matrix:
    """Return the skew-symmetric matrices (N, 3, 3) of v (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out
