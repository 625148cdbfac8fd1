"""Trajectories against ground truth: association, alignment, absolute and relative errors.

Nothing is interpolated: a pose is compared with the ground truth nearest in time, or with none.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.frontend import se3
from seamark.service.trajectory_files import load_kitti, load_trajectory, load_tum
from seamark.service.types import Trajectory

__all__ = [
    "AbsoluteError",
    "Alignment",
    "EvaluationError",
    "RelativeError",
    "Similarity",
    "Statistics",
    "align",
    "associate",
    "ate",
    "load_kitti",
    "load_trajectory",
    "load_tum",
    "pair",
    "path_length",
    "rpe",
]

Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_DIFFERENCE_S = 0.02
LEAST_PAIRS = 3


class EvaluationError(SeamarkError):
    """Two trajectories cannot be compared."""


class Alignment(StrEnum):
    """Which motion may bring the estimate onto the truth before errors are taken."""

    SE3 = "se3"
    SIM3 = "sim3"
    NONE = "none"


@dataclass(frozen=True, eq=False)
class Similarity:
    """The motion ``x_truth = scale * R @ x_estimate + t`` with R (3, 3) and t (3,)."""

    scale: float
    R: Matrix
    t: Matrix

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory moved by this similarity; rotations stay rotations."""
        T = trajectory.T_world_cam.copy()
        T[:, :3, :3] = self.R @ trajectory.T_world_cam[:, :3, :3]
        T[:, :3, 3] = self.scale * trajectory.T_world_cam[:, :3, 3] @ self.R.T + self.t
        return Trajectory(trajectory.stamps_ns, T)

    def inverse(self) -> "Similarity":
        """Return the motion from truth to estimate."""
        return Similarity(1 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)


@dataclass(frozen=True)
class Statistics:
    """Figures of a set of errors, all in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @staticmethod
    def of(errors: NDArray[np.floating]) -> "Statistics":
        """Summarise errors (N,), N > 0."""
        return Statistics(
            float(np.sqrt(np.mean(np.square(errors)))),
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.max(errors)),
        )


@dataclass(frozen=True)
class AbsoluteError:
    """ATE: distances of ``pairs`` aligned positions; ``scale`` is the alignment's, ``length_m`` the truth's."""

    translation_m: Statistics
    pairs: int
    alignment: Alignment
    scale: float
    length_m: float


@dataclass(frozen=True)
class RelativeError:
    """RPE: errors of ``pairs`` relative motions; ``delta`` says over what ("1 frame", "10 m")."""

    delta: str
    translation_m: Statistics
    rotation_deg: Statistics
    pairs: int


def associate(
    stamps_a: NDArray[np.int64], stamps_b: NDArray[np.int64], max_difference_s: float = MAX_DIFFERENCE_S
) -> tuple[Indices, Indices]:
    """Pair nearest stamps one to one, the smallest differences first; returns indices into a (ascending) and into b.

    Both (N,) and (M,) are int64 nanoseconds in any order. Of equal differences the earlier stamp wins.
    """
    order_a, order_b = np.argsort(stamps_a, kind="stable"), np.argsort(stamps_b, kind="stable")
    a, b = np.asarray(stamps_a)[order_a], np.asarray(stamps_b)[order_b]
    limit = round(max_difference_s * 1e9)
    first, last = np.searchsorted(b, a - limit, "left"), np.searchsorted(b, a + limit, "right")
    counts = last - first
    rows = np.repeat(np.arange(len(a)), counts)
    columns = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    differences = np.abs(a[rows] - b[columns])
    used_a, used_b = np.zeros(len(a), bool), np.zeros(len(b), bool)
    pairs = []
    for k in np.argsort(differences, kind="stable"):
        i, j = rows[k], columns[k]
        if not used_a[i] and not used_b[j]:
            used_a[i] = used_b[j] = True
            pairs.append((order_a[i], order_b[j]))
    found = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def align(estimate: NDArray[np.floating], truth: NDArray[np.floating], kind: Alignment | str) -> Similarity:
    """Return the motion that brings positions (N, 3) onto the truth (N, 3) with least squares (Umeyama 1991).

    Raises EvaluationError for fewer than three pairs, or where a scale is asked for and the estimate does not move.
    """
    kind = Alignment(kind)
    if kind is Alignment.NONE:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if len(estimate) < LEAST_PAIRS:
        raise EvaluationError(f"{len(estimate)} pairs of poses are too few to align; {LEAST_PAIRS} are needed")
    mean_estimate, mean_truth = estimate.mean(axis=0), truth.mean(axis=0)
    centred_estimate, centred_truth = estimate - mean_estimate, truth - mean_truth
    U, singular, Vt = np.linalg.svd(centred_truth.T @ centred_estimate / len(estimate))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ np.diag(signs) @ Vt
    scale = 1.0
    if kind is Alignment.SIM3:
        variance = float(np.mean(np.sum(centred_estimate**2, axis=1)))
        scale = float(singular @ signs) / variance if variance > 0 else 0.0
        if scale <= 0:
            raise EvaluationError("the estimate does not move with the truth, so it has no scale")
    return Similarity(scale, R, mean_truth - scale * R @ mean_estimate)


def pair(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_DIFFERENCE_S
) -> tuple[Trajectory, Trajectory]:
    """Return both trajectories cut down to poses of (nearly) the same time; raises EvaluationError if none are."""
    i, j = associate(estimate.stamps_ns, truth.stamps_ns, max_difference_s)
    if len(i) == 0:
        raise EvaluationError(
            f"no pose of the {len(estimate)} has ground truth within {max_difference_s} s ({len(truth)} poses)"
        )
    return (
        Trajectory(estimate.stamps_ns[i], estimate.T_world_cam[i]),
        Trajectory(truth.stamps_ns[j], truth.T_world_cam[j]),
    )


def path_length(trajectory: Trajectory) -> float:
    """Return the length of the path in metres."""
    return float(np.linalg.norm(np.diff(trajectory.T_world_cam[:, :3, 3], axis=0), axis=1).sum())


def ate(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment | str = Alignment.SE3,
    max_difference_s: float = MAX_DIFFERENCE_S,
) -> AbsoluteError:
    """Return the absolute trajectory error after alignment (Sturm et al. 2012); raises EvaluationError."""
    estimate, truth = pair(estimate, truth, max_difference_s)
    similarity = align(estimate.T_world_cam[:, :3, 3], truth.T_world_cam[:, :3, 3], alignment)
    moved = similarity.apply(estimate)
    errors = np.linalg.norm(moved.T_world_cam[:, :3, 3] - truth.T_world_cam[:, :3, 3], axis=1)
    return AbsoluteError(Statistics.of(errors), len(errors), Alignment(alignment), similarity.scale, path_length(truth))


def rpe(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment | str = Alignment.SE3,
    segment_m: float | None = None,
    max_difference_s: float = MAX_DIFFERENCE_S,
) -> RelativeError:
    """Return the relative pose error from each pose to the next one, or to the first one ``segment_m`` further on.

    Lengths are measured along the truth. The alignment matters only for its scale. Sturm et al. 2012 for frames, Geiger
    et al. 2012 for segments. Raises EvaluationError where no such pair of poses exists.
    """
    estimate, truth = pair(estimate, truth, max_difference_s)
    scale = align(estimate.T_world_cam[:, :3, 3], truth.T_world_cam[:, :3, 3], alignment).scale
    T_estimate = estimate.T_world_cam.copy()
    T_estimate[:, :3, 3] *= scale
    if segment_m is None:
        start, end = np.arange(len(truth) - 1), np.arange(1, len(truth))
    else:
        start, end = _segments(truth, segment_m)
    delta = "1 frame" if segment_m is None else f"{segment_m:g} m"
    if len(start) == 0:
        raise EvaluationError(f"the trajectory holds no two poses {delta} apart")
    truth_motion = se3.inverse(truth.T_world_cam[start]) @ truth.T_world_cam[end]
    errors = se3.inverse(truth_motion) @ (se3.inverse(T_estimate[start]) @ T_estimate[end])
    return RelativeError(
        delta,
        Statistics.of(np.linalg.norm(errors[:, :3, 3], axis=1)),
        Statistics.of(np.degrees(se3.rotation_angle(errors[:, :3, :3]))),
        len(start),
    )


def _segments(truth: Trajectory, length_m: float) -> tuple[Indices, Indices]:
    steps = np.linalg.norm(np.diff(truth.T_world_cam[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    end = np.searchsorted(distance, distance + length_m)
    start = np.flatnonzero(end < len(distance))
    return start, end[start]
