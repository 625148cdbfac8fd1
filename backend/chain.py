"""The odometry between any two keyframes of a session, with an honest uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import DriftConfig
from seamark.backend.errors import BackendInputError
from seamark.backend.graph_types import Node
from seamark.frontend import se3

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Relative:
    """Stacks of K motions between keyframes a and b of one session.

    ``T_a_b`` (K, 4, 4), ``covariance`` (K, 6, 6) in the frame of b, ``keyframes`` (K,) int64 steps between them, and
    ``scale_variance`` (K,) of the logarithm of the scale's drift (0 for metric sessions).
    """

    T_a_b: Matrix
    covariance: Matrix
    keyframes: NDArray[np.int64]
    scale_variance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Link:
    """One keyframe of a chain; what is summed is summed from the start of the session."""

    node: Node
    covariance_odom: Matrix  # sum of the motions' covariances, all moved to the odometry frame
    length: float
    angle: float
    steps: int


class OdometryChains:
    """The keyframes of all sessions and what odometry says between them.

    A motion's covariance is moved into the odometry frame by its adjoint and summed there, so the covariance between
    any two keyframes is a difference of two sums, moved into the frame asked for. A bias that grows with length,
    angle and count is added (see :class:`DriftConfig`).
    """

    def __init__(self, config: DriftConfig) -> None:
        self._config = config
        self._links: dict[int, _Link] = {}
        self._last: dict[int, int] = {}

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._links

    def add(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is known or its predecessor is not."""
        if node.id in self._links:
            raise BackendInputError(f"keyframe {node.id} was given twice")
        previous_id = node.previous_id if node.previous_id is not None else self._last.get(node.session)
        if previous_id is None:
            self._links[node.id] = _Link(node, np.zeros((6, 6)), 0.0, 0.0, 0)
            self._last[node.session] = node.id
            return
        before = self._links.get(previous_id)
        if before is None or before.node.session != node.session:
            raise BackendInputError(f"keyframe {node.id} follows {previous_id}, which is not known in its session")
        motion = se3.inverse(before.node.T_odom_cam) @ node.T_odom_cam
        Ad = se3.adjoint(node.T_odom_cam)
        self._links[node.id] = _Link(
            node,
            before.covariance_odom + Ad @ (node.covariance * self._config.covariance_inflation) @ Ad.T,
            before.length + float(np.linalg.norm(motion[:3, 3])),
            before.angle + float(se3.rotation_angle(motion[:3, :3])),
            before.steps + 1,
        )
        self._last[node.session] = node.id

    def node(self, keyframe_id: int) -> Node:
        """Return the keyframe; raises BackendInputError when it is unknown."""
        if keyframe_id not in self._links:
            raise BackendInputError(f"keyframe {keyframe_id} is not known")
        return self._links[keyframe_id].node

    def relative(self, ids_a: Sequence[int], ids_b: Sequence[int]) -> Relative:
        """Return the motions from each b to its a (``T_a_b``); each pair must be of one session."""
        a = [self._links[i] for i in ids_a]
        b = [self._links[i] for i in ids_b]
        T_a_odom = se3.inverse(np.stack([link.node.T_odom_cam for link in a]))
        T_odom_b = np.stack([link.node.T_odom_cam for link in b])
        Ad = adjoint_stack(se3.inverse(T_odom_b))
        summed = np.stack([x.covariance_odom for x in b]) - np.stack([x.covariance_odom for x in a])
        steps = np.array([y.steps - x.steps for x, y in zip(a, b, strict=True)], np.int64)
        summed *= np.where(steps < 0, -1.0, 1.0)[:, None, None]
        covariance = Ad @ summed @ np.swapaxes(Ad, 1, 2)
        metric = np.array([link.node.metric for link in b])
        fraction = np.where(metric, self._config.translation_fraction, self._config.mono_translation_fraction)
        lengths = np.abs([y.length - x.length for x, y in zip(a, b, strict=True)])
        angles = np.abs([y.angle - x.angle for x, y in zip(a, b, strict=True)])
        steps = np.abs(steps)
        turning = self._config.rotation_fraction * angles + np.deg2rad(self._config.rotation_deg_per_keyframe) * steps
        bias = np.repeat(np.stack([turning, fraction * lengths], axis=1), 3, axis=1)
        covariance += np.eye(6) * (bias**2)[:, :, None]
        scale_variance = np.where(metric, 0.0, self._config.scale_per_keyframe**2 * steps)
        return Relative(T_a_odom @ T_odom_b, covariance, steps, scale_variance)


def white_covariance(node: Node, motion: Matrix, config: DriftConfig) -> Matrix:
    """Return the covariance (6, 6) of one motion that stands for noise and bias in a graph of white noise."""
    translation = config.translation_fraction if node.metric else config.mono_translation_fraction
    turning = config.rotation_fraction * float(se3.rotation_angle(motion[:3, :3])) + np.deg2rad(
        config.rotation_deg_per_keyframe
    )
    bias = np.repeat([turning, translation * float(np.linalg.norm(motion[:3, 3]))], 3)
    floor_translation = config.floor_translation_m if node.metric else 1e-3 * float(np.linalg.norm(motion[:3, 3]))
    floor = np.repeat([np.deg2rad(config.floor_rotation_deg), max(floor_translation, 1e-6)], 3)
    variances = bias**2 * config.horizon_keyframes + floor**2
    covariance = config.covariance_inflation * node.covariance + np.diag(variances)
    return np.asarray(0.5 * (covariance + covariance.T))


def adjoint_stack(T: NDArray[np.floating]) -> Matrix:
    """Return the adjoints (K, 6, 6), rotation first, of rigid or similarity motions (K, 4, 4) given as [sR t; 0 1]."""
    scaled = T[:, :3, :3]
    scale = np.cbrt(np.linalg.det(scaled))
    R = scaled / scale[:, None, None]
    t = T[:, :3, 3]
    hat = np.zeros((len(T), 3, 3))
    hat[:, 0, 1], hat[:, 0, 2], hat[:, 1, 2] = -t[:, 2], t[:, 1], -t[:, 0]
    hat[:, 1, 0], hat[:, 2, 0], hat[:, 2, 1] = t[:, 2], -t[:, 1], t[:, 0]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = R
    out[:, 3:, :3] = hat @ R
    out[:, 3:, 3:] = scaled
    return out
