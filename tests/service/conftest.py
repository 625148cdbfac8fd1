"""A run of 62 frames with everything in it that results must show, made without any of the nodes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend import se3
from seamark.frontend.types import Filled, Loss, Mode, Odometry, Outcome, Quality
from seamark.service.types import KeyframeSummary, ProcessUsage, RunRecord, Trajectory

START_NS = 1_700_000_000_000_000_001
STEP_NS = 100_000_000
KEYFRAME_EVERY = 5


def true_pose(k: int) -> np.ndarray:
    """A round of 12 m radius with a bump, so that it is no circle; 60 frames close it."""
    angle = 2 * np.pi * k / 60
    position = np.array([12 * np.sin(angle), 12 - 12 * np.cos(angle), 0.3 * np.sin(2 * angle)])
    turn = se3.exp_rotation(np.array([0, 0, angle]))
    return se3.make(turn @ se3.T_WORLD_LEVEL_CAM[:3, :3], position)


def drifted_pose(k: int) -> np.ndarray:
    return se3.make(se3.exp_rotation(np.array([0, 0, 0.003 * k])), np.array([0.02 * k, 0, 0])) @ true_pose(k)


def odometry(k: int) -> Odometry:
    stamp, file = START_NS + k * STEP_NS, f"rgb/{k:03d}.png"
    if k in (30, 31):
        outcome = Outcome.UNREADABLE if k == 30 else Outcome.LOST
        loss = None if k == 30 else Loss.DARK
        return Odometry(k, stamp, file, -1 if k == 30 else 0, Quality.LOST, outcome, loss=loss)
    reference = k - k % KEYFRAME_EVERY if k not in (32, 33, 34) else 25
    T, T_reference = drifted_pose(k), drifted_pose(reference)
    return Odometry(
        index=k,
        stamp_ns=stamp,
        file=file,
        session=0,
        quality=Quality.GOOD if k % 7 else Quality.MARGINAL,
        outcome=Outcome.NEW_SESSION if k == 0 else Outcome.TRACKED,
        inliers=100 + k,
        reprojection_px=0.5,
        latency_ms=10.0 + k,
        T_odom_cam=T,
        reference_id=reference // KEYFRAME_EVERY,
        T_reference_cam=se3.inverse(T_reference) @ T,
        keyframe_id=reference // KEYFRAME_EVERY if reference == k else None,
        tracks=np.array([[10, 20, 11, 21], [30, 40, 30, 42]], np.float32),
        stages_ms={"flow": 5.0, "pose": 1.0},
    )


def loops() -> tuple[Loop, ...]:
    T = se3.inverse(true_pose(0)) @ true_pose(60)
    return (
        Loop(7, 2, False, Reason.FEW_MATCHES, 3, 0.125, 0.0625, 0.5),
        Loop(11, 0, False, Reason.FEW_INLIERS, 9, 0.25, 0.25, float("nan")),
        Loop(12, 0, True, Reason.ACCEPTED, 150, 0.75, 0.7, 0.1, T, np.eye(6)),
    )


@pytest.fixture
def make_record() -> Callable[..., RunRecord]:
    def make(mode: Mode = Mode.RGBD, *, deterministic: bool = False) -> RunRecord:
        frames = tuple(odometry(k) for k in range(62))
        ids = np.array([k for k in range(13) if k != 6], np.int64)
        T_map = np.stack([true_pose(KEYFRAME_EVERY * int(k)) for k in ids])
        snapshot = MapSnapshot(4, ids, np.zeros_like(ids), np.zeros_like(ids), T_map, np.ones(len(ids)), loops())
        stamps = START_NS + 1_000_000 + np.arange(62, dtype=np.int64) * STEP_NS
        T_moved = se3.make(se3.exp_rotation(np.array([0.1, 0.2, 2.0])), np.array([5.0, 6.0, 7.0]))
        truth = Trajectory(stamps, T_moved @ np.stack([true_pose(k) for k in range(62)]))
        keyframes = tuple(
            KeyframeSummary(int(k), 0, 5 * int(k), START_NS + 5 * int(k) * STEP_NS, f"rgb/{5 * int(k):03d}.png")
            for k in ids
        )
        record = RunRecord(
            sources=("../data/round",),
            mode=mode,
            odometry=frames,
            keyframes=keyframes,
            snapshot=snapshot,
            ground_truth=truth,
            processes=(ProcessUsage("frontend", 200 * 2**20, 3.5), ProcessUsage("backend", 100 * 2**20, 1.5)),
            wall_s=3.1,
            stages_ms={"verification": [1.0, 2.0, 3.0]},
            deterministic=deterministic,
        )
        if mode is Mode.PLACES:
            return without_poses(record)
        return in_half_units(record) if mode is Mode.MONO else record

    return make


def without_poses(record: RunRecord) -> RunRecord:
    frames = tuple(
        Odometry(f.index, f.stamp_ns, f.file, 0, Quality.GOOD, Outcome.PLACE, latency_ms=f.latency_ms)
        for f in record.odometry
    )
    T = np.full_like(record.snapshot.T_map_cam, np.nan)
    without = tuple(replace(loop, T_match_query=None) for loop in record.snapshot.loops)
    return replace(
        record, odometry=frames, ground_truth=None, snapshot=replace(record.snapshot, T_map_cam=T, loops=without)
    )


def in_half_units(record: RunRecord) -> RunRecord:
    """Mono: odometry in half metres, the map in units of 0.8 m, frames 1 to 3 filled in with frame 4."""

    def halved(T: np.ndarray | None, factor: float = 2.0) -> np.ndarray | None:
        return None if T is None else se3.make(T[:3, :3], T[:3, 3] * factor)

    frames = [
        replace(f, T_odom_cam=halved(f.T_odom_cam), T_reference_cam=halved(f.T_reference_cam)) for f in record.odometry
    ]
    filled = []
    for k in (1, 2, 3):
        T = frames[k].T_reference_cam
        assert T is not None
        filled.append(Filled(k, frames[k].stamp_ns, 0, 0, T))
        frames[k] = Odometry(k, frames[k].stamp_ns, frames[k].file, -1, Quality.LOST, Outcome.INITIALISING)
    frames[4] = replace(frames[4], filled=tuple(filled))
    T_map = record.snapshot.T_map_cam.copy()
    T_map[:, :3, 3] *= 1.25
    snapshot = replace(record.snapshot, T_map_cam=T_map, scales=np.full(len(T_map), 0.625))
    return replace(record, odometry=tuple(frames), snapshot=snapshot)
