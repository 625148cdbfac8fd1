"""What one view must show if a pose is right: landmarks that are there again, and those that are missing.

A wrong pose, or a place that only looks alike, explains some matches and leaves most of what should be visible
without any. That is evidence against it, which counting inliers never sees.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.types import Features

SEARCH_PX = 6.0
MARGIN = 0.03  # of the image, where key points are not expected
SCALE_RANGE = (0.5, 2.0)  # of the expected size over the size in the other view; beyond, SIFT finds it seldom
SMALLEST_PX = 2.5  # expected diameter of a key point that SIFT can find
HIDDEN = 0.85  # of the expected depth: what lies nearer there hides the landmark
NEIGHBOUR_PX = 16.0


@dataclass(frozen=True, eq=False)
class Sight:
    """Landmarks of one keyframe that the other must show.

    ``landmarks`` (V,) are the indices of those expected, ``pixels`` (V, 2) where, ``found`` (V,) the index of the
    feature that has been found there, -1 for none.
    """

    landmarks: NDArray[np.int64]
    pixels: NDArray[np.float64]
    found: NDArray[np.int64]

    @property
    def expected(self) -> int:
        """Return how many landmarks should be visible."""
        return len(self.landmarks)

    @property
    def confirmed(self) -> int:
        """Return how many of them are."""
        return int((self.found >= 0).sum())


def look(
    T_viewer_owner: NDArray[np.float64],
    owner: Features,
    landmarks: NDArray[np.float64],
    owner_camera: Camera,
    viewer: Features,
    viewer_landmarks: NDArray[np.float64],
    viewer_camera: Camera,
    descriptor_distance: float,
) -> Sight:
    """Look for the ``landmarks`` (N, 3) of the owner's features where the pose says that the viewer sees them.

    A feature of the viewer confirms a landmark when it lies within SEARCH_PX and its descriptor within
    ``descriptor_distance``. Landmarks outside of the image, behind something that the viewer has measured
    (``viewer_landmarks`` (M, 3)), or too small or large for SIFT are not expected.
    """
    p = se3.transform(T_viewer_owner, landmarks)
    known = np.flatnonzero(np.isfinite(p).all(axis=1) & (p[:, 2] > 0.05 * np.nanmedian(landmarks[:, 2])))
    pixels = viewer_camera.project(p[known])
    size = np.array([viewer_camera.width, viewer_camera.height])
    magnification = landmarks[known, 2] / p[known, 2] * viewer_camera.fx / owner_camera.fx
    expected = ((pixels > MARGIN * size) & (pixels < (1 - MARGIN) * size)).all(axis=1)
    expected &= (magnification > SCALE_RANGE[0]) & (magnification < SCALE_RANGE[1])
    expected &= owner.scales[known] * magnification > SMALLEST_PX
    known, pixels = known[expected], pixels[expected]
    found = np.full(len(known), -1, np.int64)
    if len(known) == 0 or len(viewer) == 0:
        return Sight(known, pixels, found)
    squared = _squared_distances(pixels, viewer.points)
    hidden = _hidden(squared, p[known, 2], viewer_landmarks[:, 2])
    known, pixels, found, squared = known[~hidden], pixels[~hidden], found[~hidden], squared[~hidden]
    rows, columns = np.nonzero(squared < SEARCH_PX**2)
    difference = owner.descriptors[known[rows]].astype(np.float32) - viewer.descriptors[columns].astype(np.float32)
    distance = np.sqrt((difference**2).sum(axis=1))
    good = distance < descriptor_distance
    rows, columns, distance = rows[good], columns[good], distance[good]
    order = np.argsort(-distance, kind="stable")
    found[rows[order]] = columns[order]  # the nearest descriptor is written last
    return Sight(known, pixels, found)


def _squared_distances(a: NDArray[np.float64], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, M) squared distances of pixels; float32 and by coordinate, because this is the costly part."""
    x = a[:, 0].astype(np.float32)[:, None] - b[:, 0]
    y = a[:, 1].astype(np.float32)[:, None] - b[:, 1]
    x *= x
    y *= y
    x += y
    return x


def _hidden(
    squared: NDArray[np.float32], depth: NDArray[np.float64], measured: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which landmarks (V,) lie behind what the viewer has measured at the nearest feature with a depth."""
    with_depth = np.flatnonzero(np.isfinite(measured))
    if len(with_depth) == 0:
        return np.zeros(len(depth), bool)
    distances = squared[:, with_depth]
    nearest = distances.argmin(axis=1)
    near = distances[np.arange(len(depth)), nearest] < NEIGHBOUR_PX**2
    return np.asarray(near & (measured[with_depth[nearest]] < HIDDEN * depth))
