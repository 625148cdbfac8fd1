"""The pose of a loop, refined by the depth images of both views, and whether these speak against it.

Iterative closest points with projective association and the distance from point to plane (Chen and Medioni 1992;
Newcombe et al., ISMAR 2011): each surface's points are looked for in the other's depth image. The pose that matches of
features have given is a prior with its covariance, so what surfaces leave free stays where features put it: on a wall
only one translation and two rotations are news. What thousands of readings have in common they do not average out:
those of one cell of the image share a part, which the residuals show, and all of a camera share an error of depth.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import AlignmentConfig
from seamark.backend.evidence import Evidence, Gate
from seamark.backend.shared_errors import independent_share, measured_share
from seamark.backend.surfaces import Surface, surface_of
from seamark.backend.types import Reason
from seamark.backend.verify import Rejected, Verification
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]
Array = NDArray[np.float64]

STEPS: Final = 15
CONVERGED: Final = 3e-5  # rad and m
CAUCHY_WIDTH: Final = 2.0  # measured standard deviations
ALIKE: Final = 0.8  # cosine between the normals of two surfaces that can be one
REACH_M, REACH_SHARE = 0.05, 0.03  # of the depth: how far apart they may be for that
GRAZING: Final = 0.15  # cosine below which a surface seen from the side counts no less
CELLS: Final = (4, 3)  # warp of a depth camera is alike over a quarter of its image
LEAST_VARIANCE: Final = 0.25  # of what is assumed: less is luck
THROUGH_NOISES, THROUGH_SHARE = 4.0, 0.03  # how much nearer than a surface seen is in the way of seeing it
SMOOTHING: Final = 200.0  # readings that are taken to agree, so that a few decide nothing


@dataclass(frozen=True, eq=False)
class Alignment:
    """How well two surfaces lie on each other.

    ``T_match_query`` with ``covariance`` (6, 6) in the query's tangent space, of features and surfaces together.
    ``overlap`` is the share of the points that meet the other surface, ``misfit`` their deviation per expected one,
    ``shift_chi2`` how far the pose has moved by the prior's covariance, ``through`` the share of the points seen by
    both that lie where the other view looks through.
    """

    T_match_query: Matrix
    covariance: Matrix
    overlap: float
    misfit: float
    shift_chi2: float
    through: float


def aligned(
    result: Verification | Rejected, query: Keyframe, match: Keyframe, config: AlignmentConfig
) -> Verification | Rejected:
    """Return what features say of two keyframes with the pose refined by depth, as it is where depth says nothing or
    does not fit, or Rejected where one view looks through what the other sees. The gates tell which.
    """
    if isinstance(result, Rejected) or not (config.enabled and query.depth and match.depth):
        return result
    if result.T_match_query is None or result.covariance is None:
        return result
    surfaces = (surface_of(query), surface_of(match))
    if surfaces[0] is None or surfaces[1] is None:
        return result
    found = align(result.T_match_query, result.covariance, surfaces[0], surfaces[1], config)
    through = Gate("depth_through", found.through, config.max_through, least=False)
    if not through.passed:
        evidence = _with(result.evidence, through)
        return Rejected(Reason.CONTRADICTED, result.inliers, result.matches, evidence)
    gates = [
        Gate("align_overlap", found.overlap, config.min_overlap),
        Gate("align_misfit", found.misfit, config.max_misfit, least=False),
        Gate("align_shift_chi2", found.shift_chi2, config.max_shift_chi2, least=False),
    ]
    if all(gate.passed for gate in gates):
        result = replace(result, T_match_query=found.T_match_query, covariance=found.covariance)
    return replace(result, evidence=_with(result.evidence, through, *gates))


def align(
    T_match_query: Matrix, covariance: Matrix, query: Surface, match: Surface, config: AlignmentConfig
) -> Alignment:
    """Return the most probable pose near ``T_match_query`` with its ``covariance``, which stay what they are where too
    little of the two surfaces meets.
    """
    pairs = _Pairs(query, match, config)
    T, prior = T_match_query, np.linalg.inv(covariance)
    system = pairs.system(T)
    for _ in range(STEPS):
        pull = system.gradient - prior @ _difference(T_match_query, T)
        change = np.linalg.solve(system.information + prior, pull)
        T = T @ se3.make(se3.exp_rotation(change[:3]), change[3:])
        system = pairs.system(T)
        if np.abs(change).max() < CONVERGED:
            break
    shift = _difference(T_match_query, T)
    combined = np.linalg.inv(system.information + prior)
    return Alignment(
        T,
        0.5 * (combined + combined.T),
        system.meeting / pairs.count,
        system.misfit,
        float(shift @ prior @ shift),
        system.through / (system.through + system.agreeing + SMOOTHING),
    )


@dataclass(frozen=True, eq=False)
class _Meeting:
    """Where the points of one view meet the other's surface: whitened distances (K,), normals (K, 3) in the viewer's
    frame, standard deviations (K,), the points in either frame (K, 3), and the cells (K,) of the viewer's image.
    """

    residuals: Array
    normals: Matrix
    sigmas: Array
    own: Matrix
    seen: Matrix
    cells: NDArray[np.int64]
    through: int
    agreeing: int


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of all distances, and what else they say."""

    information: Matrix
    gradient: Array
    misfit: float
    meeting: int
    through: int
    agreeing: int


class _Pairs:
    """Samples of two surfaces, each of which is looked for in the other."""

    def __init__(self, query: Surface, match: Surface, config: AlignmentConfig) -> None:
        self._query, self._match, self._config = query, match, config
        self._of_query, self._of_match = query.sample(config.samples), match.sample(config.samples)
        self.count = max(1, len(self._of_query) + len(self._of_match))

    def system(self, T_match_query: Matrix) -> _System:
        """Return the equations for a step from a pose, in the query's tangent space; they say nothing where too little
        meets.
        """
        config, R = self._config, T_match_query[:3, :3]
        there = _meet(T_match_query, self._query, self._of_query, self._match, config)
        back = _meet(se3.inverse(T_match_query), self._match, self._of_match, self._query, config)
        meeting = len(there.residuals) + len(back.residuals)
        seen = (there.through + back.through, there.agreeing + back.agreeing)
        if meeting < config.min_meeting:
            return _System(np.zeros((6, 6)), np.zeros(6), 0.0, meeting, *seen)
        turned = there.normals @ R
        J = np.concatenate(
            [
                np.hstack([np.cross(there.own, turned), turned]) / there.sigmas[:, None],
                -np.hstack([np.cross(back.seen, back.normals), back.normals]) / back.sigmas[:, None],
            ]
        )
        r = np.concatenate([there.residuals, back.residuals])
        cells = np.concatenate([there.cells, back.cells + CELLS[0] * CELLS[1]])
        width = CAUCHY_WIDTH * max(1.4826 * float(np.median(np.abs(r))), np.sqrt(LEAST_VARIANCE) / 2)
        robust = 1 / (1 + (r / width) ** 2)
        variance = float((robust * r**2).sum() / robust.sum())
        expected = max(variance, LEAST_VARIANCE)
        share = measured_share([((r * np.sqrt(robust))[:, None], robust, cells)], config.shared_share)
        # Both ways see the same two surfaces: together they say as much as one.
        weight = 0.5 * robust * independent_share(cells, share) / expected
        information, gradient = (J * weight[:, None]).T @ J, -(J * weight[:, None]).T @ r
        # An error that all readings share is one of the pose: it is integrated out.
        common = np.linalg.inv(information + np.diag(1 / self._common(there, back, expected) ** 2))
        return _System(
            information - information @ common @ information,
            gradient - information @ (common @ gradient),
            float(np.sqrt(variance)),
            meeting,
            *seen,
        )

    def _common(self, there: _Meeting, back: _Meeting, variance: float) -> Array:
        """Return the standard deviations (6,), rotation first, of what all readings of the two views err by."""
        depth = float(np.median(np.concatenate([there.own[:, 2], back.seen[:, 2]])))
        translation = self._config.shared_depth * _sigma(np.array(depth), self._config) * np.sqrt(variance)
        return np.repeat([translation / depth, translation], 3)


def _meet(T: Matrix, owner: Surface, samples: NDArray[np.intp], viewer: Surface, config: AlignmentConfig) -> _Meeting:
    """Look for samples of one surface in the depth image of another camera; ``T`` maps owner to viewer."""
    own = owner.points[samples]
    p = se3.transform(T, own)
    ahead = np.flatnonzero(p[:, 2] > 0.05)
    index, inside = viewer.cells(viewer.camera.project(p[ahead]))
    ahead, index = ahead[inside], index[inside]
    known = viewer.inverse_depth[index] > 0
    ahead, index = ahead[known], index[known]
    own, p = own[ahead], p[ahead]
    # What is nearer than the surface behind it would have been seen; what is farther is hidden.
    z, inverse = p[:, 2], viewer.inverse_depth[index]
    noise = np.hypot(_sigma(1 / inverse, config) * inverse**2, _sigma(own[:, 2], config) / z**2)
    tolerance = THROUGH_NOISES * noise + THROUGH_SHARE * inverse
    nearer = 1 / z - inverse
    through = nearer > tolerance
    agreeing = int((np.abs(nearer) <= tolerance).sum())
    surface, normals = viewer.points[index], viewer.normals[index]
    with np.errstate(invalid="ignore"):
        meets = np.einsum("ij,ij->i", normals, owner.normals[samples[ahead]] @ T[:3, :3].T) > ALIKE
        meets &= np.linalg.norm(p - surface, axis=1) < REACH_M + REACH_SHARE * surface[:, 2]
    own, p, surface, normals = own[meets], p[meets], surface[meets], normals[meets]
    slant = np.maximum(np.abs(np.einsum("ij,ij->i", normals, surface)) / surface[:, 2], GRAZING)
    sigmas = np.hypot(_sigma(surface[:, 2], config), _sigma(own[:, 2], config)) * slant
    residuals = np.einsum("ij,ij->i", normals, p - surface) / sigmas
    rows, columns = np.divmod(index[meets], viewer.shape[1])
    cells = rows * CELLS[1] // viewer.shape[0] * CELLS[0] + columns * CELLS[0] // viewer.shape[1]
    return _Meeting(residuals, normals, sigmas, own, p, cells.astype(np.int64), int(through.sum()), agreeing)


def _sigma(depth: Array, config: AlignmentConfig) -> Array:
    """Return the expected standard deviation (m) of a reading of the reduced depth image."""
    return config.depth_sigma_floor_m + config.depth_sigma_per_m2 * depth**2


def _difference(T_from: Matrix, T_to: Matrix) -> Array:
    """Return the tangent vector (6,) that leads from one pose to another, rotation first."""
    E = se3.inverse(T_from) @ T_to
    return np.concatenate([se3.log_rotation(E[:3, :3]), E[:3, 3]])


def _with(evidence: Evidence | None, *gates: Gate) -> Evidence | None:
    return None if evidence is None else replace(evidence, gates=(*evidence.gates, *gates))
