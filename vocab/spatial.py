"""Second stage of retrieval: do the features that two images share lie to each other as in one view of one place?"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.vocab.errors import ObservationError
from seamark.vocab.kernels import native
from seamark.vocab.vocabulary import check_descriptors

MATCH_RATIO: Final = 0.8
TOLERANCE: Final = 0.06
"""How far, per image diagonal, a feature may be from where the similarity puts it: scenes have depth."""

MAX_TURN: Final = float(np.deg2rad(30))  # cameras stand upright; a feature turned further is a chance match
MAX_SCALE_STEP: Final = 0.7  # of the logarithm of scale, from one feature to another of the same view
SUPPORT_WEIGHT: Final = 1.0 / 30.0
"""Weight of SpatialEvidence.support beside the score of the place index."""

FEW_INLIERS: Final = 20.0  # with fewer inliers scale and warp are hardly measured and count less
REFINEMENTS = 3
PIXELS_APART = 1 << 32  # no image is so high


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """The local features of one image of ``width`` x ``height`` pixels.

    ``points`` (N, 2) float32 pixels, ``scales`` (N,) float32 pixels, ``angles`` (N,) float32 radians, ``descriptors``
    (N, 128) uint8 RootSIFT.
    """

    points: NDArray[np.float32]
    scales: NDArray[np.float32]
    angles: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    width: int
    height: int

    @property
    def diagonal(self) -> float:
        """Return the diagonal of the image in pixels."""
        return float(np.hypot(self.width, self.height))


@dataclass(frozen=True)
class SpatialEvidence:
    """How well one similarity transform explains the features that two images share.

    ``matches`` are mutual nearest neighbours that pass the ratio test, ``inliers`` those near where the transform puts
    them. ``log_scale`` is the logarithm of its scale: 0 where the camera stood equally far away. ``warp`` is the median
    distance, per diagonal, of inliers from where a mere shift would put them: small where the camera stood at the very
    spot and only turned.
    """

    matches: int = 0
    inliers: int = 0
    log_scale: float = 0.0
    warp: float = 0.0

    @property
    def support(self) -> float:
        """Return by how much the evidence raises a place in the ranking, at least 0.

        It is ln(1 + inliers) less what tells that the camera stood elsewhere. That part counts by how well it is
        measured, and never more than the inliers bring.
        """
        elsewhere = 2.0 * min(abs(self.log_scale), 0.7) + 10.0 * min(self.warp, 0.05)
        return float(np.log1p(self.inliers) - self.inliers / (self.inliers + FEW_INLIERS) * elsewhere)


def compare(query: LocalFeatures, place: LocalFeatures) -> SpatialEvidence:
    """Match the features of two images and count those that one upright similarity transform explains.

    Every match is a hypothesis, because scale and orientation of a pair of features fix a similarity (fast spatial
    matching: Philbin et al., CVPR 2007); the one with most inliers is refined by least squares.

    Raises:
        ObservationError: descriptors of another shape or type, or arrays of unequal length.
    """
    for features in (query, place):
        check_descriptors(features.descriptors)
        if not len(features.points) == len(features.scales) == len(features.angles) == len(features.descriptors):
            raise ObservationError("points, scales, angles and descriptors must be of one length")
    rows, columns = _distinct_matches(query, place)
    if len(rows) < 2:
        return SpatialEvidence(len(rows), 0)
    tolerance = TOLERANCE * place.diagonal
    a, b = _complex(query.points[rows]), _complex(place.points[columns])
    inliers = _best_hypothesis(query, place, rows, columns, tolerance)
    similarity = 1.0 + 0.0j
    for _ in range(REFINEMENTS):
        if inliers.sum() < 3:
            break
        similarity, error = _fit(a, b, inliers)
        if (error < tolerance).sum() < 3 or ((error < tolerance) == inliers).all():
            break
        inliers = error < tolerance
    count = int(inliers.sum())
    if count < 3:
        return SpatialEvidence(len(rows), count)
    shift = (b - a)[inliers]
    middle = complex(np.median(shift.real), np.median(shift.imag))
    warp = float(np.median(np.abs(shift - middle))) / place.diagonal
    return SpatialEvidence(len(rows), count, float(np.log(max(abs(similarity), 1e-6))), warp)


def _best_hypothesis(
    query: LocalFeatures,
    place: LocalFeatures,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Return the matches (M,) that agree with the match that most agree with."""
    log_scale = np.log(place.scales[columns]) - np.log(query.scales[rows])
    turn = (place.angles[columns] - query.angles[rows] + np.pi) % (2 * np.pi) - np.pi
    here, there = query.points[rows], place.points[columns]
    x, y, to_x, to_y, growth, spin = (
        np.ascontiguousarray(values, np.float32)
        for values in (here[:, 0], here[:, 1], there[:, 0], there[:, 1], log_scale, turn)
    )
    agree = native.similarity(x, y, to_x, to_y, growth, spin, tolerance, MAX_SCALE_STEP, MAX_TURN)
    return agree.view(np.bool_)


def _fit(
    a: NDArray[np.complex128], b: NDArray[np.complex128], inliers: NDArray[np.bool_]
) -> tuple[complex, NDArray[np.float64]]:
    """Fit b = s a + t to the inliers by least squares: s, and the errors of all."""
    centre_a, centre_b = a[inliers].mean(), b[inliers].mean()
    spread = a[inliers] - centre_a
    power = float((np.abs(spread) ** 2).sum())
    similarity = complex((np.conj(spread) * (b[inliers] - centre_b)).sum() / max(power, 1e-9))
    return similarity, np.abs(similarity * (a - centre_a) - (b - centre_b))


def _distinct_matches(query: LocalFeatures, place: LocalFeatures) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of mutual nearest neighbours that pass the ratio test (Lowe 2004), one for each pixel."""
    if len(query.descriptors) < 2 or len(place.descriptors) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = native.mutual(np.ascontiguousarray(query.descriptors), np.ascontiguousarray(place.descriptors))
    rows, columns, first, second = pairs.T.astype(np.int64)
    quotient = first / np.maximum(second, 1)
    keep = np.flatnonzero(quotient < MATCH_RATIO**2)
    keep = keep[np.argsort(quotient[keep], kind="stable")]  # of key points at one pixel the clearest match is kept
    for points, indices in ((query.points, rows), (place.points, columns)):
        pixels = np.round(points[indices[keep]]).astype(np.int64)
        _, first_of_pixel = np.unique(pixels[:, 0] * PIXELS_APART + pixels[:, 1], return_index=True)
        keep = keep[np.sort(first_of_pixel)]
    return rows[keep], columns[keep]


def _complex(points: NDArray[np.float32]) -> NDArray[np.complex128]:
    return points[:, 0].astype(np.complex128) + 1j * points[:, 1]
