"""What a keyframe's pose is to GTSAM: a rigid pose, or one with a scale."""

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import DriftConfig, GraphConfig
from seamark.backend.consistency import similarity
from seamark.backend.graph_types import Constraint, Node

Matrix = NDArray[np.float64]


class PoseVariables:
    """Rigid poses as GTSAM variables."""

    def __init__(self, config: GraphConfig, drift: DriftConfig) -> None:
        self._config, self._drift = config, drift

    def value(self, M: Matrix) -> Any:
        """Return the variable of pose M."""
        return gtsam.Pose3(gtsam.Rot3.ClosestTo(M[:3, :3]), M[:3, 3])

    def matrices(self, values: gtsam.Values, ids: NDArray[np.int64]) -> Matrix:
        """Return the poses (N, 4, 4) of ascending ids, which must be all."""
        rows = gtsam.utilities.extractPose3(values)  # (N, 12) in key order: rotation row-major, then translation
        out = np.tile(np.eye(4), (len(ids), 1, 1))
        out[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        out[:, :3, 3] = rows[:, 9:]
        return out

    def prior(self, keyframe_id: int, M: Matrix, sigma: float | None = None) -> gtsam.NonlinearFactor:
        """Hold a pose, the first of a component unless ``sigma`` (rad, length) says how firmly."""
        noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma or self._config.prior_sigma)
        return gtsam.PriorFactorPose3(keyframe_id, self.value(M), noise)

    def odometry(self, previous_id: int, node: Node, motion: Matrix, covariance: Matrix) -> gtsam.NonlinearFactor:
        """Join a keyframe with its predecessor."""
        noise = self._gaussian(covariance)
        return gtsam.BetweenFactorPose3(previous_id, node.id, self.value(motion), noise)

    def loop(self, constraint: Constraint) -> gtsam.NonlinearFactor:
        """Join a keyframe with the one it has recognised."""
        measured = self.value(constraint.T_match_query)
        robust = _cauchy(self._gaussian(constraint.covariance), self._config.cauchy_width)
        return gtsam.BetweenFactorPose3(constraint.match_id, constraint.query_id, measured, robust)

    def _gaussian(self, covariance: Matrix) -> gtsam.noiseModel.Gaussian:
        return gtsam.noiseModel.Gaussian.Covariance(covariance)

    def covariance(self, block: Matrix) -> Matrix:
        """Return a variable's marginal covariance as (6, 6), rotation first."""
        return np.asarray(block[:6, :6])

    def make_isam(self) -> gtsam.ISAM2:
        """Return an empty iSAM2; QR, because Cholesky fails on long open chains."""
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(self._config.relinearise_threshold)
        return gtsam.ISAM2(parameters)


class PlanarVariables(PoseVariables):
    """Poses in the plane z = 0 as GTSAM's Pose2, tangent x, y, turn; a third of the work of rigid poses."""

    AXES = (3, 4, 2)  # where x, y and the turn lie among six

    def value(self, M: Matrix) -> Any:
        """Return the variable of pose M."""
        return gtsam.Pose2(M[0, 3], M[1, 3], float(np.arctan2(M[1, 0], M[0, 0])))

    def matrices(self, values: gtsam.Values, ids: NDArray[np.int64]) -> Matrix:
        """Return the poses (N, 4, 4) of ascending ids, which must be all."""
        x, y, theta = gtsam.utilities.extractPose2(values).T
        out = np.tile(np.eye(4), (len(ids), 1, 1))
        out[:, 0, 0] = out[:, 1, 1] = np.cos(theta)
        out[:, 1, 0] = np.sin(theta)
        out[:, 0, 1] = -out[:, 1, 0]
        out[:, 0, 3], out[:, 1, 3] = x, y
        return out

    def prior(self, keyframe_id: int, M: Matrix, sigma: float | None = None) -> gtsam.NonlinearFactor:
        """Hold a pose, the first of a component unless ``sigma`` (rad, length) says how firmly."""
        noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma or self._config.prior_sigma)
        return gtsam.PriorFactorPose2(keyframe_id, self.value(M), noise)

    def odometry(self, previous_id: int, node: Node, motion: Matrix, covariance: Matrix) -> gtsam.NonlinearFactor:
        """Join a keyframe with its predecessor."""
        noise = self._gaussian(covariance)
        return gtsam.BetweenFactorPose2(previous_id, node.id, self.value(motion), noise)

    def loop(self, constraint: Constraint) -> gtsam.NonlinearFactor:
        """Join a keyframe with the one it has recognised."""
        measured = self.value(constraint.T_match_query)
        robust = _cauchy(self._gaussian(constraint.covariance), self._config.cauchy_width)
        return gtsam.BetweenFactorPose2(constraint.match_id, constraint.query_id, measured, robust)

    def _gaussian(self, covariance: Matrix) -> gtsam.noiseModel.Gaussian:
        return gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(self.AXES, self.AXES)])

    def covariance(self, block: Matrix) -> Matrix:
        """Return a variable's marginal covariance as (6, 6), rotation first; zero along what a plane does not know."""
        out = np.zeros((6, 6))
        out[np.ix_(self.AXES, self.AXES)] = block
        return out


class SimilarityVariables(PoseVariables):
    """Poses with a scale: GTSAM's Similarity3 is p' = s (R p + t), tangent rotation, translation, log scale."""

    def value(self, M: Matrix) -> Any:
        """Return the variable of M = [sR t; 0 1]."""
        scale = float(np.cbrt(np.linalg.det(M[:3, :3])))
        return gtsam.Similarity3(gtsam.Rot3.ClosestTo(M[:3, :3] / scale), M[:3, 3] / scale, scale)

    def matrices(self, values: gtsam.Values, ids: NDArray[np.int64]) -> Matrix:
        """Return [sR t; 0 1] (N, 4, 4) of the ids."""
        out = np.tile(np.eye(4), (len(ids), 1, 1))
        for row, keyframe_id in zip(out, ids.tolist(), strict=True):
            value = values.atSimilarity3(keyframe_id)
            row[:3, :3] = value.scale() * value.rotation().matrix()
            row[:3, 3] = value.scale() * value.translation()
        return out

    def prior(self, keyframe_id: int, M: Matrix, sigma: float | None = None) -> gtsam.NonlinearFactor:
        """Hold a pose and its scale, the first of a component unless ``sigma`` says how firmly."""
        noise = gtsam.noiseModel.Isotropic.Sigma(7, sigma or self._config.prior_sigma)
        return gtsam.PriorFactorSimilarity3(keyframe_id, self.value(M), noise)

    def odometry(self, previous_id: int, node: Node, motion: Matrix, covariance: Matrix) -> gtsam.NonlinearFactor:
        """Join a keyframe with its predecessor; the scale may drift where the session is not metric."""
        scale_sigma = 1e-4 if node.metric else self._drift.scale_per_keyframe
        scale_sigma *= 1.0 if node.span is None else node.span.steps**0.5
        noise = _with_scale(covariance, scale_sigma)
        return gtsam.BetweenFactorSimilarity3(previous_id, node.id, self.value(motion), noise)

    def loop(self, constraint: Constraint) -> gtsam.NonlinearFactor:
        """Join a keyframe with the one it has recognised, scale included."""
        robust = _cauchy(_with_scale(constraint.covariance, constraint.scale_sigma), self._config.cauchy_width)
        measured = self.value(similarity(constraint))
        return gtsam.BetweenFactorSimilarity3(constraint.match_id, constraint.query_id, measured, robust)


def _with_scale(covariance: Matrix, scale_sigma: float) -> gtsam.noiseModel.Gaussian:
    out = np.zeros((7, 7))
    out[:6, :6] = covariance
    out[6, 6] = scale_sigma**2
    return gtsam.noiseModel.Gaussian.Covariance(out)


def _cauchy(noise: gtsam.noiseModel.Gaussian, width: float) -> gtsam.noiseModel.Robust:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(width), noise)
