"""The first map of a mono session from two views: essential matrix or homography, whichever explains more.

Both are estimated and scored (Mur-Artal et al., ORB-SLAM, 2015, section IV). What lies in one plane fits a homography,
and then up to four motions explain the two views (Faugeras and Lustman 1988). Points behind a camera rule out most of
them, and a third view between the two decides between what is left, or nothing is decided yet.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.two_view import TwoView, normalised_rays, rotation_compensated_parallax, triangulate

ESSENTIAL_PX = 1.0
HOMOGRAPHY_PX = 1.5
CHI2_1DOF_95, CHI2_2DOF_95 = 3.84, 5.99
PLANE_SHARE = 0.45  # of the two scores together: from here on the homography is taken
ALL_BUT_A_FEW = 0.95  # of what fits the essential matrix lies in the plane: what does not would decide between motions
RIVAL_SHARE = 0.75  # of the landmarks of the best motion: with so many another one is a rival
DECISIVE = 0.75  # of the rival's error in the third view: the right motion stays below
THIRD_VIEW_PX = 1.5
MIN_THIRD_VIEW = 12  # landmarks

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Motions:
    """Candidates ``T_first_second`` and the corners (N,) that fit the model which they come from."""

    T_first_second: list[Array]
    inliers: NDArray[np.bool_]


def first_map(
    pixels_first: Array,
    pixels_second: Array,
    camera: Camera,
    *,
    min_parallax_px: float,
    min_landmarks: int,
    min_angle_deg: float,
    pixels_between: Array | None = None,
) -> TwoView | str:
    """Build a first map from two views, or say in a word why it is not yet safe.

    Ideal pixels (N, 2) of the same corners; ``pixels_between`` (N, 2) of a third view, NaN where a corner was not seen.
    A motion is refused for little parallax after the rotation is taken out (pure rotation), for few points in front of
    both cameras or with a wide enough angle, and where another does as well. The median depth becomes 1.
    """
    if len(pixels_first) < min_landmarks:
        return "few_tracks"
    motions = _motions(pixels_first, pixels_second, camera)
    if motions is None:
        return "no_motion"
    if motions.inliers.sum() < min_landmarks:
        return "few_inliers"
    rays_first, rays_second = normalised_rays(pixels_first, camera), normalised_rays(pixels_second, camera)
    maps, refusals = [], []
    for T_first_second in motions.T_first_second:
        parallax = rotation_compensated_parallax(T_first_second[:3, :3], pixels_first, rays_second, camera)
        points, angle = triangulate(np.eye(4), rays_first, T_first_second, rays_second)
        good = motions.inliers & np.isfinite(points[:, 0]) & (angle > np.deg2rad(min_angle_deg))
        if float(np.median(parallax[motions.inliers])) < min_parallax_px:
            refusals.append("little_parallax")
        elif good.sum() < max(min_landmarks, 0.5 * motions.inliers.sum()):
            refusals.append("few_landmarks")
        else:
            scale = 1 / float(np.median(points[good, 2]))
            T_scaled = se3.make(T_first_second[:3, :3], scale * T_first_second[:3, 3])
            maps.append(TwoView(T_scaled, np.where(good[:, None], points * scale, np.nan)))
    if not maps:
        return refusals[0] if refusals else "no_motion"
    return _decided(maps, pixels_between, camera)


def _motions(pixels_first: Array, pixels_second: Array, camera: Camera) -> _Motions | None:
    """Return the motions of the model that explains more."""
    E, mask = cv2.findEssentialMat(
        pixels_first, pixels_second, camera.K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=ESSENTIAL_PX
    )
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    inliers = mask.reshape(-1).astype(bool)
    H, _ = cv2.findHomography(pixels_first, pixels_second, cv2.USAC_MAGSAC, HOMOGRAPHY_PX, confidence=0.999)
    if H is not None:
        by_plane, on_plane = _homography_score(H, pixels_first, pixels_second)
        all_in_plane = on_plane[inliers].sum() >= ALL_BUT_A_FEW * inliers.sum()
        by_epipole = _essential_score(E, pixels_first, pixels_second, camera)
        if all_in_plane and by_plane > PLANE_SHARE * (by_plane + by_epipole):
            return _Motions(_plane_motions(H, camera), on_plane)
    _, R, t, _ = cv2.recoverPose(E, pixels_first, pixels_second, camera.K, mask=mask.copy())
    return _Motions([se3.inverse(se3.make(R, t))], inliers)


def _plane_motions(H: Array, camera: Camera) -> list[Array]:
    """Return the motions (4, 4) that a homography of pixels can come from; a rotation alone moves nothing."""
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, camera.K)
    motions = []
    for R, t in zip(rotations, translations, strict=True):
        if np.linalg.norm(t) > 0:
            motions.append(se3.inverse(se3.make(R, t / np.linalg.norm(t))))
    return motions


def _homography_score(H: Array, pixels_first: Array, pixels_second: Array) -> tuple[float, NDArray[np.bool_]]:
    """Return how well a homography explains both views, and which corners (N,) it explains in each."""
    score, fits = 0.0, np.ones(len(pixels_first), bool)
    for matrix, here, there in ((H, pixels_first, pixels_second), (np.linalg.inv(H), pixels_second, pixels_first)):
        squared = ((cv2.perspectiveTransform(here[:, None], matrix)[:, 0] - there) ** 2).sum(axis=1)
        close = squared < CHI2_2DOF_95
        score += float((CHI2_2DOF_95 - squared[close]).sum())
        fits &= close
    return score, fits


def _essential_score(E: Array, pixels_first: Array, pixels_second: Array, camera: Camera) -> float:
    """Return how well an essential matrix explains both views, in the units of the homography's score."""
    K_inverse = np.linalg.inv(camera.K)
    F = K_inverse.T @ E @ K_inverse
    first, second = (np.column_stack([p, np.ones(len(p))]) for p in (pixels_first, pixels_second))
    score = 0.0
    for lines, points in ((first @ F.T, second), (second @ F, first)):
        squared = (lines * points).sum(axis=1) ** 2 / np.maximum((lines[:, :2] ** 2).sum(axis=1), 1e-18)
        close = squared < CHI2_1DOF_95
        score += float((CHI2_2DOF_95 - squared[close]).sum())
    return score


def _decided(maps: list[TwoView], pixels_between: Array | None, camera: Camera) -> TwoView | str:
    """Return the map that is right, or say that two of them may be."""
    sizes = [int(np.isfinite(m.landmarks[:, 0]).sum()) for m in maps]
    rivals = [m for m, size in zip(maps, sizes, strict=True) if size >= RIVAL_SHARE * max(sizes)]
    if len(rivals) == 1:
        return rivals[0]
    if pixels_between is None:
        return "ambiguous_plane"
    errors = np.array([_third_view_px(m, pixels_between, camera) for m in rivals])
    order = np.argsort(errors)
    best, second = errors[order[:2]]
    if best < THIRD_VIEW_PX and best < DECISIVE * second:
        return rivals[int(order[0])]
    return "ambiguous_plane"


def _third_view_px(two_view: TwoView, pixels: Array, camera: Camera) -> float:
    """Return the median error of a map in a view that it was not made from, infinite where that cannot be said."""
    known = np.isfinite(two_view.landmarks[:, 0]) & np.isfinite(pixels[:, 0])
    if known.sum() < MIN_THIRD_VIEW:
        return np.inf
    points, seen = two_view.landmarks[known], np.ascontiguousarray(pixels[known])
    ok, rotation, translation = cv2.solvePnP(points, seen, camera.K, None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        return np.inf
    rotation, translation = cv2.solvePnPRefineLM(points, seen, camera.K, None, rotation, translation)
    projected = cv2.projectPoints(points, rotation, translation, camera.K, None)[0][:, 0]
    return float(np.median(np.linalg.norm(projected - seen, axis=1)))
