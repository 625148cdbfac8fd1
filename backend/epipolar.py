"""What two views without depth say of each other: which matches agree, and the pose up to its length.

An essential matrix of known cameras holds the rotation between them and the direction in which one lies from the other.
Both are refined on all matches that agree, and said only where the views settle them: without parallax there is no
direction, and a plane has two poses that explain it alike.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import VerificationConfig
from seamark.backend.pose_errors import PoseSystem
from seamark.backend.shared_errors import cells_of, excess_angle, independent_share, measured_share
from seamark.backend.verify_pose import usac_parameters
from seamark.frontend import se3
from seamark.frontend.camera import Camera

Matrix = NDArray[np.float64]
Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

STEPS: Final = 10
SQRT2: Final = float(np.sqrt(2.0))  # both views have a key point
CONVERGED: Final = 1e-7
CAUCHY_WIDTH: Final = 2.5  # standard deviations
PRIOR_FREEDOM: Final = 30.0
# Rays nearer to each other than this, in standard deviations, are of something far away.
COINCIDENT: Final = 3.0
IN_FRONT: Final = 0.8  # of the matches
# Noise alone looks like parallax and would hold a direction; what is shown must do so this many times better.
PARALLAX: Final = 10.0
ONE_PLANE: Final = 0.8  # of the matches: where one homography explains so many, two poses do
MOST_BEARING_SIGMA: Final = float(np.deg2rad(10))


@dataclass(frozen=True, eq=False)
class Direction:
    """The pose between two cameras without its length.

    ``R_match_query`` (3, 3); ``bearing`` (3,) is the unit vector from the match's camera to the query's, in the match's
    frame. ``rotation_sigma`` and ``bearing_sigma`` (rad) are their standard deviations in their worst directions.
    """

    R_match_query: Matrix
    bearing: Array
    rotation_sigma: float
    bearing_sigma: float


@dataclass(frozen=True, eq=False)
class Views:
    """Pixels (M, 2) of M matches; ideal ones where the ``cameras`` of query and match are known."""

    query: Matrix
    match: Matrix
    cameras: tuple[Camera, Camera] | None

    def some(self, chosen: Flags) -> "Views":
        """Return these matches alone."""
        return Views(self.query[chosen], self.match[chosen], self.cameras)


def fit_epipolar(views: Views, config: VerificationConfig, seed: int) -> tuple[Matrix | None, Flags]:
    """Return the essential matrix (the fundamental one without cameras) and which matches (M,) it explains; None where
    there is none.
    """
    parameters = usac_parameters(config.epipolar_px, config, seed)
    fit = partial(cv2.findFundamentalMat, views.query, views.match, parameters)
    if views.cameras is not None:
        K_query, K_match = (camera.K for camera in views.cameras)
        fit = partial(cv2.findEssentialMat, views.query, views.match, K_query, K_match, None, None, parameters)
    essential = views.cameras is not None
    try:
        model, mask = fit()
    except cv2.error:
        # OpenCV 5.0 asserts when its last refinement degenerates, as it does for two almost equal images.
        limits = (config.epipolar_px, config.confidence, config.iterations)
        model, mask = cv2.findFundamentalMat(views.query, views.match, cv2.FM_RANSAC, *limits)
        essential = False
    if model is None or mask is None or model.shape != (3, 3) or not np.isfinite(model).all():
        return None, np.zeros(len(views.query), bool)
    if views.cameras is not None and not essential:
        model = K_match.T @ model @ K_query
    return model, mask.reshape(-1).astype(bool)


def direction_of(E: Matrix, views: Views, inliers: Flags, config: VerificationConfig) -> Direction | None:
    """Return the pose up to its length that the matches hold, near an essential matrix that explains ``inliers`` (M,).

    Which matches belong to it is decided anew at each step, or those that a coarse matrix left out would be missed.
    None where they leave it open: behind the cameras, all on one plane, with little parallax, or too few.
    """
    assert views.cameras is not None
    rays_query, rays_match = (
        np.column_stack([(uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(uv))])
        for uv, camera in zip((views.query, views.match), views.cameras, strict=True)
    )
    start = _in_front(E, rays_query[inliers], rays_match[inliers], SQRT2 * config.noise_px / views.cameras[1].fx)
    if start is None:
        return None
    R, t = start
    for _ in range(STEPS):
        J, r, basis, _ = _system(R, t, rays_query, rays_match, views, config, config.shared_share)
        information = J.T @ J + 1e-9 * np.eye(5)
        step = np.linalg.solve(information, -J.T @ r)
        R, t = R @ se3.exp_rotation(step[:3]), t + basis @ step[3:]
        t /= np.linalg.norm(t)
        if np.abs(step).max() < CONVERGED:
            break
    return _sure(R, t, rays_query, rays_match, views, config)


def _sure(
    R: Matrix, t: Array, rays_query: Matrix, rays_match: Matrix, views: Views, config: VerificationConfig
) -> Direction | None:
    """Return what of a refined pose the matches hold."""
    assert views.cameras is not None
    match = views.cameras[1]
    share = config.shared_share
    for _ in range(2):  # the second time with what neighbours are seen to share
        J, r, _, weights = _system(R, t, rays_query, rays_match, views, config, share)
        used = weights > 0
        if np.count_nonzero(used) < config.min_epipolar_inliers:
            return None
        flat = np.column_stack([r, np.zeros(len(r))])[used]
        share = measured_share([(flat, weights[used], cells_of(views.match[used], match))], config.shared_share)
    # Only upwards: what lies beyond the limit was left out, so that the rest seems better than it is.
    scale = max((PRIOR_FREEDOM + float((r**2).sum())) / (PRIOR_FREEDOM + max(float(weights.sum()) - 5, 0.0)), 1.0)
    if np.linalg.cond(J.T @ J) > 1e9:
        return None
    # As for poses with depth: no single match, which may be a wrong one near a line, is to hold what is claimed.
    left = PoseSystem(J, r, np.arange(len(r)), scale, share).without_one(np.ones(5))
    turn, way = (float(np.sqrt(np.linalg.eigvalsh(left[:, one, one])[:, -1].max())) for one in (slice(3), slice(3, 5)))
    if 1 / way**2 < PARALLAX * float(weights.sum()) or _on_one_plane(views.some(used), config):
        return None
    # What the whole view errs by in common turns it, and is taken for a part of the parallax.
    turned = float(se3.rotation_angle(R))
    angle = np.hypot(
        excess_angle(scale, share, match.fx, config),
        np.deg2rad(config.rotation_floor_deg) + config.rotation_systematic * turned,
    )
    turn, way = (
        float(np.hypot(turn, angle)),
        float(np.hypot(way, angle / _parallax(R, rays_query[used], rays_match[used]))),
    )
    sure = np.rad2deg(turn) < config.max_rotation_sigma_deg and way < MOST_BEARING_SIGMA
    return Direction(R, t, turn, way) if sure else None


def _parallax(R: Matrix, rays_query: Matrix, rays_match: Matrix) -> float:
    """Return the middle angle (rad) between the rays of both views."""
    turned = rays_query @ R.T
    sine = np.linalg.norm(np.cross(turned, rays_match), axis=1)
    return float(np.median(np.arctan2(sine, (turned * rays_match).sum(axis=1))))


def _in_front(E: Matrix, rays_query: Matrix, rays_match: Matrix, noise: float) -> tuple[Matrix, Array] | None:
    """Return that one of the four poses of an essential matrix which has the matches ahead of both cameras."""
    R1, R2, t = cv2.decomposeEssentialMat(E)
    best, most = None, 0
    for R in (R1, R2):
        for way in (t[:, 0], -t[:, 0]):
            far, ahead = _ahead(rays_query @ R.T, rays_match, way, noise)
            near = len(far) - int(far.sum())
            if ahead.sum() > most and (far | ahead).mean() >= IN_FRONT and (ahead & ~far).sum() >= IN_FRONT * near:
                best, most = (R, way), int(ahead.sum())
    return best


def _ahead(turned: Matrix, rays_match: Matrix, t: Array, noise: float) -> tuple[Flags, Flags]:
    """Return which rays (M, 3), the query's ``turned`` into the match, show no parallax, as far away, and which meet
    ahead of both cameras.
    """
    normal = np.cross(turned, rays_match)
    far = (np.linalg.norm(normal, axis=1) < COINCIDENT * noise * turned[:, 2]) & (turned[:, 2] > 0)
    in_match = (normal * np.cross(turned, t)).sum(axis=1) > 0
    in_query = (normal * np.cross(rays_match, t)).sum(axis=1) > 0
    return np.asarray(far), np.asarray(in_match & in_query)


def _system(
    R: Matrix,
    t: Array,
    rays_query: Matrix,
    rays_match: Matrix,
    views: Views,
    config: VerificationConfig,
    share: float,
) -> tuple[Matrix, Array, Matrix, Array]:
    """Return the Jacobian (M, 5), rotation first, of the distances (M,) from the epipolar lines in standard deviations
    (Sampson 1982), the basis (3, 2) of the bearing's tangent, and the weights (M,), 0 for
    those that do not belong to it; weighed already.
    """
    assert views.cameras is not None
    query, match = views.cameras
    turned = rays_query @ R.T
    line_match, line_query = np.cross(t, turned), np.cross(rays_match, t) @ R
    spread = (line_match[:, 0] / match.fx) ** 2 + (line_match[:, 1] / match.fy) ** 2
    spread += (line_query[:, 0] / query.fx) ** 2 + (line_query[:, 1] / query.fy) ** 2
    whitening = 1 / (config.noise_px * np.sqrt(np.maximum(spread, 1e-18)))
    basis = np.linalg.svd(t[None])[2][1:].T
    r = whitening * (rays_match * line_match).sum(axis=1)
    J = np.hstack([np.cross(rays_query, line_query), np.cross(turned, rays_match) @ basis]) * whitening[:, None]
    weights = 1 / (1 + r**2 / CAUCHY_WIDTH**2)
    near = np.abs(r) * config.noise_px < config.epipolar_px
    near &= np.logical_or(*_ahead(turned, rays_match, t, SQRT2 * config.noise_px / match.fx))
    weights[near] *= independent_share(cells_of(views.match[near], match), share)
    weights[~near] = 0
    root = np.sqrt(weights)
    return J * root[:, None], r * root, basis, weights


def _on_one_plane(views: Views, config: VerificationConfig) -> bool:
    """Return whether one homography explains nearly all matches."""
    limits = (cv2.RANSAC, config.reprojection_px, None, config.iterations, config.confidence)
    found, mask = cv2.findHomography(views.query, views.match, *limits)
    return found is not None and float(mask.mean()) >= ONE_PLANE
