"""What the keyframes of a bundle adjustment have seen, as arrays in the order of the tracks' observations."""

from collections.abc import Mapping

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from seamark.backend.tracks import Tracks
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]


class Observations:
    """M observations of tracks: ``pixels`` (M, 2) without distortion, and ``points`` (M, 3) in the camera's frame and
    map units, NaN where no depth was measured.
    """

    def __init__(self, keyframes: Mapping[int, Keyframe], tracks: Tracks, scales: Mapping[int, float]) -> None:
        self._keyframes, self._tracks = keyframes, tracks
        pixels = np.empty((len(tracks.track), 2))
        points = np.full((len(tracks.track), 3), np.nan)  # in the camera's frame, in map units
        for number, keyframe in keyframes.items():
            mine = tracks.keyframe == number
            assert keyframe.camera is not None
            pixels[mine] = keyframe.camera.undistort(keyframe.features.points[tracks.feature[mine]])
            points[mine] = keyframe.landmarks[tracks.feature[mine]].astype(np.float64) * scales[number]
        self.pixels, self.points = pixels, points

    def initial(self, T_map_cam: Mapping[int, Matrix]) -> gtsam.Values:
        """Return the map's poses, and each track's landmark as the middle of what its keyframes say."""
        values = gtsam.Values()
        for number in self._keyframes:
            T = T_map_cam[number]
            values.insert(X(number), gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3]))
        world = np.full((len(self.pixels), 3), np.nan)
        for number in self._keyframes:
            mine = self._tracks.keyframe == number
            world[mine] = se3.transform(T_map_cam[number], self.points[mine])
        for track, rows in self._rows():
            values.insert(L(track), np.nanmedian(world[rows], axis=0))
        return values

    def placed_by(self, inverse: NDArray[np.float64], values: gtsam.Values) -> gtsam.Values:
        """Return the solution with each landmark where inverse depths (M,) put it, if there are any for it.

        What parallax alone has placed may lie far off or behind, from where no step leads to where depths have it.
        """
        out = gtsam.Values(values)
        points = self.points * (1 / (inverse * self.points[:, 2]))[:, None]
        world = np.full((len(points), 3), np.nan)
        for number in self._keyframes:
            mine = self._tracks.keyframe == number
            world[mine] = se3.transform(values.atPose3(X(number)).matrix(), points[mine])
        for track, rows in self._rows():
            known = rows[np.isfinite(world[rows, 0])]
            if len(known) and out.exists(L(track)):
                out.update(L(track), np.median(world[known], axis=0))
        return out

    def errors_px(self, values: gtsam.Values) -> NDArray[np.float64]:
        """Return reprojection errors (M,); infinite for landmarks that the values lack or behind the camera."""
        out = np.full(len(self.pixels), np.inf)
        points = self.landmarks(values)
        for number, keyframe in self._keyframes.items():
            mine = np.flatnonzero(self._tracks.keyframe == number)
            T = se3.inverse(values.atPose3(X(number)).matrix())
            p = se3.transform(T, points[self._tracks.track[mine]])
            ahead = p[:, 2] > 1e-6
            assert keyframe.camera is not None
            uv = keyframe.camera.project_ideal(p[ahead])
            out[mine[ahead]] = np.linalg.norm(uv - self.pixels[mine[ahead]], axis=1)
        return out

    def within(self, values: gtsam.Values, sigmas: float, sigma_px: float) -> NDArray[np.bool_]:
        """Return which observations (M,) are no outliers and belong to a landmark with at least two such."""
        errors = self.errors_px(values)
        typical = max(sigma_px, float(np.median(errors[np.isfinite(errors)])))
        good: NDArray[np.bool_] = errors < sigmas * typical
        count = np.bincount(self._tracks.track[good], minlength=int(self._tracks.track.max()) + 1)
        return np.asarray(good & (count[self._tracks.track] >= 2))

    def landmarks(self, values: gtsam.Values) -> Matrix:
        """Return the landmark (3,) of each track, NaN where the values have none."""
        points = np.full((int(self._tracks.track.max()) + 1, 3), np.nan)
        for track in range(len(points)):
            if values.exists(L(track)):
                points[track] = values.atPoint3(L(track))
        return points

    def depths(self, values: gtsam.Values) -> NDArray[np.float64]:
        """Return where (M,) a solution has each observation's landmark along the camera's axis, NaN behind it."""
        points = self.landmarks(values)[self._tracks.track]
        out = np.full(len(points), np.nan)
        for number in self._keyframes:
            mine = self._tracks.keyframe == number
            out[mine] = se3.transform(se3.inverse(values.atPose3(X(number)).matrix()), points[mine])[:, 2]
        return np.where(out > 1e-6, out, np.nan)

    def _rows(self) -> list[tuple[int, NDArray[np.int64]]]:
        """Return for each track which observations are its."""
        starts = np.flatnonzero(np.r_[True, np.diff(self._tracks.track) > 0])
        ends = np.r_[starts[1:], len(self._tracks.track)]
        return [(int(self._tracks.track[a]), np.arange(a, b)) for a, b in zip(starts, ends, strict=True)]
