"""The odometry between any two keyframes of a session, with an honest uncertainty."""

from collections import ChainMap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import DriftConfig
from seamark.backend.errors import BackendInputError
from seamark.backend.graph_types import Node
from seamark.frontend import se3

Matrix = NDArray[np.float64]
_FIRST_ROWS = 1024


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


class OdometryChains:
    """The keyframes of all sessions and what odometry says between them.

    A motion's covariance is moved into the odometry frame by its adjoint and summed there, so the covariance between
    any two keyframes is a difference of two sums, moved into the frame asked for. A bias that grows with length,
    angle and count is added (see :class:`DriftConfig`). All sums run from the start of the session, in columns with
    one row per keyframe.
    """

    def __init__(self, config: DriftConfig) -> None:
        self._config = config
        self._inflation = config.covariance_inflation
        self._nodes: list[Node] = []
        self._rows: dict[int, int] = {}
        self._last: dict[int, int] = {}  # session -> row of its last keyframe
        self._T_odom_cam = np.zeros((_FIRST_ROWS, 4, 4))
        self._covariance_odom = np.zeros((_FIRST_ROWS, 6, 6))
        self._walked = np.zeros((_FIRST_ROWS, 2))  # angle, length
        self._steps = np.zeros(_FIRST_ROWS, np.int64)
        self._metric = np.zeros(_FIRST_ROWS, bool)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._rows

    def add(self, node: Node) -> None:
        """Append a keyframe; raises BackendInputError when it is known or its predecessor is not."""
        self.extend([node])

    def extend(self, nodes: Sequence[Node]) -> None:
        """Append keyframes; raises BackendInputError as ``add`` does, and then none of them is appended."""
        first, before = len(self._nodes), self._predecessors(nodes)
        rows = np.arange(first, first + len(nodes))
        self._grow(first + len(nodes))
        self._T_odom_cam[rows] = np.stack([node.T_odom_cam for node in nodes])
        self._metric[rows] = [node.metric for node in nodes]
        motions = se3.inverse(self._T_odom_cam[np.where(before < 0, rows, before)]) @ self._T_odom_cam[rows]
        Ad = adjoint_stack(self._T_odom_cam[rows])
        covariances = np.stack([node.covariance for node in nodes]) * self._inflation
        moved = Ad @ covariances @ np.swapaxes(Ad, 1, 2)
        walked = np.stack([se3.rotation_angle(motions[:, :3, :3]), np.linalg.norm(motions[:, :3, 3], axis=1)], axis=1)
        for k, (row, previous) in enumerate(zip(rows.tolist(), before.tolist(), strict=True)):
            if previous >= 0:
                self._covariance_odom[row] = self._covariance_odom[previous] + moved[k]
                span = nodes[k].span
                way, steps = (walked[k], 1) if span is None else (np.array([span.angle, span.length]), span.steps)
                self._walked[row] = self._walked[previous] + way
                self._steps[row] = self._steps[previous] + steps
        for row, node in zip(rows.tolist(), nodes, strict=True):
            self._nodes.append(node)
            self._rows[node.id] = self._last[node.session] = row

    def inflate(self, factor: float) -> None:
        """Multiply the covariances of all motions, past and to come: odometry is worse than was thought."""
        self._inflation *= factor
        self._covariance_odom *= factor

    def nodes(self) -> tuple[Node, ...]:
        """Return all keyframes in the order in which they were appended."""
        return tuple(self._nodes)

    def node(self, keyframe_id: int) -> Node:
        """Return the keyframe; raises BackendInputError when it is unknown."""
        if keyframe_id not in self._rows:
            raise BackendInputError(f"keyframe {keyframe_id} is not known")
        return self._nodes[self._rows[keyframe_id]]

    def step(self, keyframe_id: int) -> int:
        """Return how many motions lie between the start of the session and the keyframe."""
        return int(self._steps[self._rows[keyframe_id]])

    def extent(self) -> Matrix:
        """Return the sides (3,) of the box that holds all keyframes' odometry positions."""
        positions = self._T_odom_cam[: len(self._nodes), :3, 3]
        return np.ptp(positions, axis=0) if len(positions) else np.zeros(3)

    def relative(self, ids_a: Sequence[int], ids_b: Sequence[int]) -> Relative:
        """Return the motions from each b to its a (``T_a_b``); each pair must be of one session."""
        a = np.array([self._rows[i] for i in ids_a], np.int64)
        b = np.array([self._rows[i] for i in ids_b], np.int64)
        T_odom_b = self._T_odom_cam[b]
        Ad = adjoint_stack(se3.inverse(T_odom_b))
        steps = self._steps[b] - self._steps[a]
        summed = self._covariance_odom[b] - self._covariance_odom[a]
        summed *= np.where(steps < 0, -1.0, 1.0)[:, None, None]
        covariance = Ad @ summed @ np.swapaxes(Ad, 1, 2)
        steps, metric = np.abs(steps), self._metric[b]
        fraction = np.where(metric, self._config.translation_fraction, self._config.mono_translation_fraction)
        angles, lengths = np.abs(self._walked[b] - self._walked[a]).T
        turning = self._config.rotation_fraction * angles + np.deg2rad(self._config.rotation_deg_per_keyframe) * steps
        bias = np.repeat(np.stack([turning, fraction * lengths], axis=1), 3, axis=1)
        covariance += np.eye(6) * (bias**2)[:, :, None]
        scale_variance = np.where(metric, 0.0, self._config.scale_per_keyframe**2 * steps)
        return Relative(se3.inverse(self._T_odom_cam[a]) @ T_odom_b, covariance, steps, scale_variance)

    def _predecessors(self, nodes: Sequence[Node]) -> NDArray[np.int64]:
        """Return the row (N,) that each keyframe hangs on, -1 where it starts a session."""
        rows: ChainMap[int, int] = ChainMap({}, self._rows)
        last: ChainMap[int, int] = ChainMap({}, self._last)
        first, out = len(self._nodes), np.full(len(nodes), -1)
        for row, node in enumerate(nodes, start=first):
            if node.id in rows:
                raise BackendInputError(f"keyframe {node.id} was given twice")
            before = rows.get(node.previous_id) if node.previous_id is not None else last.get(node.session)
            session = None
            if before is not None:
                session = (self._nodes[before] if before < first else nodes[before - first]).session
            if node.previous_id is not None and session != node.session:
                raise BackendInputError(
                    f"keyframe {node.id} follows {node.previous_id}, which is not known in its session"
                )
            out[row - first] = -1 if before is None else before
            rows[node.id] = last[node.session] = row
        return out

    def _grow(self, rows: int) -> None:
        """Make room for so many rows; doubling keeps the cost per keyframe constant."""
        while len(self._steps) < rows:
            self._T_odom_cam = np.concatenate([self._T_odom_cam, np.zeros_like(self._T_odom_cam)])
            self._covariance_odom = np.concatenate([self._covariance_odom, np.zeros_like(self._covariance_odom)])
            self._walked = np.concatenate([self._walked, np.zeros_like(self._walked)])
            self._steps = np.concatenate([self._steps, np.zeros_like(self._steps)])
            self._metric = np.concatenate([self._metric, np.zeros_like(self._metric)])


def white_covariance(node: Node, motion: Matrix, config: DriftConfig) -> Matrix:
    """Return the covariance (6, 6) of one motion that stands for noise and bias in a graph of white noise."""
    return white_covariances([node], motion[None], config)[0]


def white_covariances(nodes: Sequence[Node], motions: Matrix, config: DriftConfig, share: float = 1.0) -> Matrix:
    """Return the covariances (N, 6, 6) of motions (N, 4, 4) that stand for noise and bias in a graph of white noise.

    ``share`` of what is allowed beyond the odometry's own covariances is taken (see drift.py).
    """
    metric = np.array([node.metric for node in nodes], bool)
    lengths = np.linalg.norm(motions[:, :3, 3], axis=1)
    angles = se3.rotation_angle(motions[:, :3, :3])
    turning = config.rotation_fraction * angles + np.deg2rad(config.rotation_deg_per_keyframe)
    moving = np.where(metric, config.translation_fraction, config.mono_translation_fraction) * lengths
    floor = np.maximum(np.where(metric, config.floor_translation_m, 1e-3 * lengths), 1e-6)
    horizon = share * config.horizon_keyframes
    turned = turning**2 * horizon + np.deg2rad(config.floor_rotation_deg) ** 2
    drift = np.repeat(np.stack([turned, moving**2 * horizon + floor**2], axis=1), 3, axis=1)[:, :, None] * np.eye(6)
    for row, node in enumerate(nodes):
        if node.span is not None:
            drift[row] = share * node.span.drift
    out = config.covariance_inflation * np.stack([node.covariance for node in nodes]) + drift
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


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
