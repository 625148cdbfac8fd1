"""The local window: bundle adjustment over the recent keyframes, in numpy with the landmarks eliminated.

Triggs et al., "Bundle Adjustment - A Modern Synthesis" (2000), section 6.1: the reduced camera system has 6 rows per
keyframe. A window of 8 keyframes and 400 landmarks is one small dense system, so that plain arrays beat a general
graph solver here.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.residuals import (
    HUBER,
    Observations,
    pose_jacobian,
    residuals_and_jacobian,
    retract,
    robust_weights,
)

INITIAL_DAMPING = 1e-4
RELATIVE_DECREASE = 1e-4


@dataclass(frozen=True, eq=False)
class WindowKeyframe:
    """What the window keeps of a keyframe: its pose and what it saw.

    ``track_ids`` (M,) int64, ``seen`` (M, 2) float32 pixels as seen in ``grey`` (H, W), ``pixels`` (M, 2) the ideal
    ones, ``inverse_depth`` and ``inverse_sigma`` (M,) NaN where unknown.
    """

    id: int
    stamp_ns: int
    T_odom_cam: NDArray[np.float64]
    grey: NDArray[np.uint8]
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


@dataclass(frozen=True, eq=False)
class _State:
    poses: NDArray[np.float64]
    landmarks: NDArray[np.float64]
    depth_offset: float


@dataclass(frozen=True, eq=False)
class _Linearised:
    cost: float
    errors_px: NDArray[np.float64]
    residuals: NDArray[np.float64]
    J_pose: NDArray[np.float64]
    J_landmark: NDArray[np.float64]
    J_depth: NDArray[np.float64]  # (O,) of the third residual by the offset


def adjust(problem: BundleProblem, camera: Camera, *, pixel_sigma: float, iterations: int) -> BundleResult:
    """Minimise the robust error of all observations over poses, landmarks and depth offset (Levenberg-Marquardt)."""
    state = _State(problem.poses.copy(), problem.landmarks.copy(), problem.depth_offset.value)
    damping = INITIAL_DAMPING
    starts = np.flatnonzero(np.diff(problem.landmark_of, prepend=-1))
    current = _linearise(problem, state, camera, pixel_sigma)
    for _ in range(iterations):
        system = _Reduced.of(problem, current, starts, damping, state.depth_offset)
        try:
            trial_state = system.step(state, problem.n_fixed)
        except np.linalg.LinAlgError:  # a landmark or pose that nothing determines: hold it more firmly
            damping *= 10
            continue
        trial = _linearise(problem, trial_state, camera, pixel_sigma)
        if trial.cost < current.cost:
            decrease = 1 - trial.cost / current.cost
            state, current, damping = trial_state, trial, damping * 0.1
            if decrease < RELATIVE_DECREASE:
                break
        else:
            damping *= 10
    final = _Reduced.of(problem, current, starts, 0.0, state.depth_offset)
    try:
        information = final.depth_information(problem)
    except np.linalg.LinAlgError:
        information = 0.0
    poses = np.stack([se3.orthonormalise(T) for T in state.poses])
    return BundleResult(poses, state.landmarks, current.errors_px, final.inverse_ll, state.depth_offset, information)


def _linearise(problem: BundleProblem, state: _State, camera: Camera, pixel_sigma: float) -> _Linearised:
    poses, measured = state.poses, problem.measured
    R_cam_odom = np.swapaxes(poses[problem.keyframe_of, :3, :3], 1, 2)
    offset = state.landmarks[problem.landmark_of] - poses[problem.keyframe_of, :3, 3]
    in_cam = (R_cam_odom @ offset[:, :, None])[:, :, 0]
    in_cam[:, 2] = np.maximum(in_cam[:, 2], 1e-2)
    residuals, J_point = residuals_and_jacobian(in_cam, measured, camera, pixel_sigma)
    J_depth = -np.nan_to_num(1 / measured.inverse_sigma)
    residuals[:, 2] += J_depth * state.depth_offset
    weights = robust_weights(residuals)
    root = np.sqrt(weights)
    J_point = J_point * root[:, :, None]
    return _Linearised(
        cost=_huber_cost(residuals) + _prior_cost(problem.depth_offset, state.depth_offset),
        errors_px=np.linalg.norm(residuals[:, :2], axis=1) * pixel_sigma,
        residuals=residuals * root,
        J_pose=J_point @ pose_jacobian(in_cam),
        J_landmark=J_point @ R_cam_odom,
        J_depth=J_depth * root[:, 2],
    )


def _huber_cost(residuals: NDArray[np.float64]) -> float:
    norms = np.concatenate([np.linalg.norm(residuals[:, :2], axis=1), np.abs(residuals[:, 2])])
    return float(np.where(norms < HUBER, 0.5 * norms**2, HUBER * (norms - 0.5 * HUBER)).sum())


def _prior_cost(prior: DepthOffset, offset: float) -> float:
    return 0.5 * prior.information * (offset - prior.value) ** 2


@dataclass(frozen=True, eq=False)
class _Reduced:
    """The normal equations with the landmarks eliminated: 6 rows per pose, then one of the depth offset.

    ``S`` (M, M) and ``b`` (M,) of the reduced system; ``W`` (L, M, 3), ``inverse_ll`` (L, 3, 3) and ``b_l`` (L, 3) give
    the landmarks back.
    """

    S: NDArray[np.float64]
    b: NDArray[np.float64]
    W: NDArray[np.float64]
    inverse_ll: NDArray[np.float64]
    b_l: NDArray[np.float64]

    @staticmethod
    def of(
        problem: BundleProblem,
        at: _Linearised,
        starts: NDArray[np.int64],
        damping: float,
        offset: float,
    ) -> "_Reduced":
        """Build the system at a linearisation; ``starts`` (L,) are the first observations of each landmark."""
        n_poses, n_landmarks = len(problem.poses), len(problem.landmarks)
        Jl_t = np.swapaxes(at.J_landmark, 1, 2)
        H_ll = np.add.reduceat(Jl_t @ at.J_landmark, starts, axis=0)
        b_l = np.add.reduceat((Jl_t @ at.residuals[:, :, None])[:, :, 0], starts, axis=0)
        diagonal = np.arange(3)
        H_ll[:, diagonal, diagonal] *= 1 + damping
        H_ll[:, diagonal, diagonal] += 1e-9
        inverse_ll = np.linalg.inv(H_ll)

        blocks = np.zeros((n_landmarks, n_poses, 6, 3))
        blocks[problem.landmark_of, problem.keyframe_of] = np.swapaxes(at.J_pose, 1, 2) @ at.J_landmark
        of_depth = np.add.reduceat(at.J_depth[:, None] * at.J_landmark[:, 2], starts, axis=0)
        W = np.concatenate([blocks.reshape(n_landmarks, n_poses * 6, 3), of_depth[:, None]], axis=1)
        WH = W @ inverse_ll
        last = n_poses * 6
        size = last + 1
        S = -(WH.transpose(1, 0, 2).reshape(size, -1) @ W.transpose(1, 0, 2).reshape(size, -1).T)
        b = -np.einsum("lij,lj->i", WH, b_l)
        for k in range(n_poses):
            mine, rows = problem.keyframe_of == k, slice(6 * k, 6 * k + 6)
            J = at.J_pose[mine].reshape(-1, 6)
            H = J.T @ J
            H[np.arange(6), np.arange(6)] *= 1 + damping
            S[rows, rows] += H
            b[rows] += J.T @ at.residuals[mine].reshape(-1)
            shared = at.J_pose[mine, 2].T @ at.J_depth[mine]
            S[rows, last] += shared
            S[last, rows] += shared
        prior = problem.depth_offset
        S[last, last] += at.J_depth @ at.J_depth + prior.information
        b[last] += at.J_depth @ at.residuals[:, 2] + prior.information * (offset - prior.value)
        return _Reduced(S, b, W, inverse_ll, b_l)

    def step(self, state: _State, n_fixed: int) -> _State:
        """Return the state after one step that leaves the first ``n_fixed`` poses where they are."""
        n_poses, free = len(state.poses), slice(6 * n_fixed, None)
        delta = np.zeros(len(self.b))
        size = len(self.b) - 6 * n_fixed
        delta[free] = -np.linalg.solve(self.S[free, free] + 1e-9 * np.eye(size), self.b[free])
        reaction = self.b_l + np.einsum("lij,i->lj", self.W, delta)
        of_landmarks = -(self.inverse_ll @ reaction[:, :, None])[:, :, 0]
        of_poses = delta[:-1].reshape(n_poses, 6)
        return _State(
            np.stack([retract(T, d) for T, d in zip(state.poses, of_poses, strict=True)]),
            state.landmarks + of_landmarks,
            state.depth_offset + float(delta[-1]),
        )

    def depth_information(self, problem: BundleProblem) -> float:
        """Return what the observations say about the depth offset when poses and landmarks are unknown."""
        free = slice(6 * problem.n_fixed, -1)
        across = self.S[free, -1]
        poses = self.S[free, free] + 1e-9 * np.eye(len(across))
        own = self.S[-1, -1] - problem.depth_offset.information
        return max(0.0, float(own - across @ np.linalg.solve(poses, across)))


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
        index, held = self._find(track_ids)
        out[held] = self._positions[index[held]]
        return out

    def spread(self, track_ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the spreads (N,); forgotten and new ids are NaN."""
        out = np.full(len(track_ids), np.nan)
        index, held = self._find(track_ids)
        out[held] = self._spreads[index[held]]
        return out

    def set(self, track_ids: NDArray[np.int64], positions: NDArray[np.float64], spreads: NDArray[np.float64]) -> None:
        """Store positions (N, 3) and spreads (N,) of different ids."""
        ids = np.concatenate([track_ids, self._ids])
        self._ids, first = np.unique(ids, return_index=True)  # of an id that is held the new position comes first
        self._positions = np.vstack([positions, self._positions])[first]
        self._spreads = np.concatenate([spreads, self._spreads])[first]

    def retain(self, track_ids: NDArray[np.int64]) -> None:
        """Forget all ids but these: one track that lives for ever must not keep all that came after it."""
        kept = np.isin(self._ids, track_ids)
        self._ids, self._positions, self._spreads = self._ids[kept], self._positions[kept], self._spreads[kept]

    def _find(self, track_ids: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        if len(self._ids) == 0:
            return np.zeros(len(track_ids), np.intp), np.zeros(len(track_ids), bool)
        index = np.minimum(np.searchsorted(self._ids, track_ids), len(self._ids) - 1)
        return index, self._ids[index] == track_ids
