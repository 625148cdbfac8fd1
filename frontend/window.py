"""The local window: bundle adjustment over the recent keyframes, with the landmarks eliminated.

Triggs et al., "Bundle Adjustment - A Modern Synthesis" (2000), section 6.1: the reduced camera system has 6 rows per
keyframe. A window of 8 keyframes and 500 landmarks is one small dense system: native/window.cpp solves it in 1 ms with
the interpreter free, where plain arrays take 40 and a general graph solver about as long.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.kernels import native
from seamark.frontend.pyramid import Pyramid
from seamark.frontend.residuals import Observations

INITIAL_DAMPING = 1e-4
RELATIVE_DECREASE = 1e-3  # the next keyframe goes on from here


@dataclass(frozen=True, eq=False)
class WindowKeyframe:
    """What the window keeps of a keyframe: its pose and what it saw.

    ``id`` is the keyframe's in the map, None for one that serves the window only.
    ``track_ids`` (M,) int64, ``seen`` (M, 2) float32 pixels as seen in ``image``, ``pixels`` (M, 2) the ideal
    ones, ``inverse_depth`` and ``inverse_sigma`` (M,) NaN where unknown.
    """

    id: int | None
    stamp_ns: int
    T_odom_cam: NDArray[np.float64]
    image: Pyramid
    track_ids: NDArray[np.int64]
    seen: NDArray[np.float32]
    pixels: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    inverse_sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """K poses, L landmarks and O observations, sorted by landmark.

    ``poses`` (K, 4, 4), the first ``n_fixed`` of which hold the gauge, ``landmarks`` (L, 3), ``keyframe_of`` and
    ``landmark_of`` (O,) indices, ``measured`` what was seen (its ``landmarks`` field is not used).
    """

    poses: NDArray[np.float64]
    n_fixed: int
    landmarks: NDArray[np.float64]
    keyframe_of: NDArray[np.int64]
    landmark_of: NDArray[np.int64]
    measured: Observations
    depth_offset: DepthOffset


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The adjusted ``poses`` (K, 4, 4), ``landmarks`` (L, 3) and each observation's error (O,) in pixels.

    ``landmark_covariances`` (L, 3, 3) take the poses for exact.

    ``depth_offset`` (1/m) is the sensor's, ``depth_information`` what the observations alone say about it.
    """

    poses: NDArray[np.float64]
    landmarks: NDArray[np.float64]
    errors_px: NDArray[np.float64]
    landmark_covariances: NDArray[np.float64]
    depth_offset: float
    depth_information: float


def adjust(problem: BundleProblem, camera: Camera, *, pixel_sigma: float, iterations: int) -> BundleResult:
    """Minimise the robust error of all observations over poses, landmarks and depth offset (Levenberg-Marquardt)."""
    measured = problem.measured
    poses, landmarks, errors, covariances, depth_offset, depth_information = native.adjust(
        np.ascontiguousarray(problem.poses),
        problem.n_fixed,
        np.ascontiguousarray(problem.landmarks),
        problem.keyframe_of,
        problem.landmark_of,
        np.ascontiguousarray(measured.pixels),
        measured.inverse_depth,
        measured.inverse_sigma,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        pixel_sigma,
        problem.depth_offset.value,
        problem.depth_offset.information,
        iterations,
        INITIAL_DAMPING,
        RELATIVE_DECREASE,
    )
    poses = se3.orthonormalise(poses)
    return BundleResult(poses, landmarks, errors * pixel_sigma, covariances, depth_offset, depth_information)


class LandmarkTable:
    """Positions (3,) in the odometry frame by track id, NaN where unknown; as long as what it is told to keep.

    Beside each position is its spread: the relative standard deviation of its distance from where it was seen.
    """

    def __init__(self) -> None:
        self._ids = np.zeros(0, np.int64)  # ascending
        self._positions = np.zeros((0, 3))
        self._spreads = np.zeros(0)

    def __len__(self) -> int:
        """Return the number of ids that are held, unknown positions included."""
        return len(self._ids)

    def get(self, track_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return positions (N, 3); forgotten and new ids are NaN."""
        out = np.full((len(track_ids), 3), np.nan)
        index, held = self.rows(track_ids)
        out[held] = self._positions[index[held]]
        return out

    def known(self, track_ids: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
        """Return which of the ids (N,) have a position, and of those the positions (K, 3) and spreads (K,)."""
        index, held = self.rows(track_ids)
        held[held] = np.isfinite(self._positions[index[held], 0])
        return held, self._positions[index[held]], self._spreads[index[held]]

    def seen_often(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return those of the rows (N,) that are there twice at least and have a position, ascending (K,), and these
        positions (K, 3).
        """
        chosen = np.flatnonzero(np.bincount(rows, minlength=1) >= 2)
        chosen = chosen[np.isfinite(self._positions[chosen, 0])]
        return chosen, self._positions[chosen]

    def ids(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        """Return the ids (N,) of rows."""
        return self._ids[rows]

    def spread(self, track_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the spreads (N,); forgotten and new ids are NaN."""
        out = np.full(len(track_ids), np.nan)
        index, held = self.rows(track_ids)
        out[held] = self._spreads[index[held]]
        return out

    def set(self, track_ids: NDArray[np.int64], positions: NDArray[np.float64], spreads: NDArray[np.float64]) -> None:
        """Store positions (N, 3) and spreads (N,) of different ids."""
        index, held = self.rows(track_ids)
        self._positions[index[held]], self._spreads[index[held]] = positions[held], spreads[held]
        if held.all():
            return
        ids = np.concatenate([self._ids, track_ids[~held]])
        order = np.argsort(ids, kind="stable")
        self._ids = ids[order]
        self._positions = np.vstack([self._positions, positions[~held]])[order]
        self._spreads = np.concatenate([self._spreads, spreads[~held]])[order]

    def retain(self, track_ids: NDArray[np.int64]) -> None:
        """Forget all ids but these: one track that lives for ever must not keep all that came after it."""
        kept = np.isin(self._ids, track_ids)
        self._ids, self._positions, self._spreads = self._ids[kept], self._positions[kept], self._spreads[kept]

    def rows(self, track_ids: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the rows (N,) of ids, and which of them (N,) are held at all."""
        if len(self._ids) == 0:
            return np.zeros(len(track_ids), np.intp), np.zeros(len(track_ids), bool)
        index = np.minimum(np.searchsorted(self._ids, track_ids), len(self._ids) - 1)
        return index, self._ids[index] == track_ids


def bundle_of(
    views: Sequence[WindowKeyframe], n_fixed: int, table: LandmarkTable, depth_offset: DepthOffset
) -> tuple[BundleProblem, NDArray[np.int64]]:
    """Return what keyframes, the first ``n_fixed`` of which are held, say of each other through known landmarks.

    The landmarks are those that are seen twice at least; their ids (L,) are returned as well.
    """
    ids = np.concatenate([k.track_ids for k in views])
    keyframe_of = np.repeat(np.arange(len(views)), [len(k.track_ids) for k in views])
    rows, held = table.rows(ids)
    chosen, positions = table.seen_often(rows[held])
    number = np.full(len(table) + 1, -1, np.int64)
    number[chosen] = np.arange(len(chosen))
    landmark_of = number[np.where(held, rows, -1)]
    use = np.flatnonzero(landmark_of >= 0)
    # a sort of 16-bit numbers takes one pass
    use = use[np.argsort(landmark_of[use].astype(np.uint16 if len(chosen) < 2**16 else np.int64), kind="stable")]
    measured = Observations(
        landmarks=np.zeros((len(use), 3)),
        pixels=np.vstack([k.pixels for k in views])[use],
        inverse_depth=np.concatenate([k.inverse_depth for k in views])[use],
        inverse_sigma=np.concatenate([k.inverse_sigma for k in views])[use],
    )
    problem = BundleProblem(
        poses=np.stack([k.T_odom_cam for k in views]),
        n_fixed=n_fixed,
        landmarks=positions,
        keyframe_of=keyframe_of[use],
        landmark_of=landmark_of[use],
        measured=measured,
        depth_offset=depth_offset,
    )
    return problem, table.ids(chosen)
