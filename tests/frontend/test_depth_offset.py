"""A stereo rig whose calibration is off: the window learns the offset of its disparities, and the scale is right."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend.camera import Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Mode

WORLD = ToyWorld(7)
OFFSET_PX = 0.5
N_FRAMES = 70


def off_calibration() -> Rig:
    """Return the toy world's rig as a calibration sees it that puts the right camera's centre half a pixel wrong."""
    rig = WORLD.rig(Mode.STEREO)
    assert rig.cam1 is not None
    return replace(rig, cam1=replace(rig.cam1, cx=rig.cam1.cx + OFFSET_PX))


def travel(rig: Rig, systematic_px: float) -> tuple[float, float]:
    """Return by how much the way after the first third comes out too long, and what is believed of the offset (px)."""
    sequence = toy_sequence("line", N_FRAMES, sensors=Mode.STEREO, world=WORLD)
    config = FrontendConfig(max_corners=250, sift_features=100, disparity_systematic_px=systematic_px)
    frontend = Frontend(rig, Mode.STEREO, config)
    try:
        poses = [frontend.step(frame).odometry.T_odom_cam for frame in sequence.frames()]
    finally:
        frontend.close()
    assert all(T is not None for T in poses)
    where = np.stack([T[:3, 3] for T in poses if T is not None])[N_FRAMES // 3 :]
    true = sequence.ground_truth.T_world_cam[N_FRAMES // 3 :, :3, 3]
    length, true_length = (float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for p in (where, true))
    session = frontend._session
    assert session is not None and rig.T_cam0_cam1 is not None
    baseline_m = float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))
    return length / true_length - 1, session.depth_offset.value * rig.cam0.fx * baseline_m


def test_an_offset_of_the_disparities_is_learned_and_the_scale_comes_right() -> None:
    ignored, _ = travel(off_calibration(), 0.0)
    learned, offset_px = travel(off_calibration(), 0.5)
    assert -0.1 < ignored < -0.02
    assert abs(learned) < 0.01
    assert offset_px == pytest.approx(-OFFSET_PX, abs=0.12)


def test_a_rig_that_is_right_is_left_as_it_is() -> None:
    error, offset_px = travel(WORLD.rig(Mode.STEREO), 0.5)
    assert abs(offset_px) < 0.1
    assert abs(error) < 0.01


def test_knowledge_grows_with_observations_and_fades_without() -> None:
    start = DepthOffset.expected(0.01)
    assert (start.value, start.information) == (0.0, pytest.approx(1e4))
    once = start.learned(0.004, 9e4)
    assert (once.value, once.information) == (0.004, pytest.approx(1e5))
    faded = once
    for _ in range(2000):
        faded = faded.learned(0.004, 0.0)
    assert start.information < faded.information < 1.02 * start.information
    np.testing.assert_allclose(once.correct(np.array([0.1, np.nan, -0.01])), [0.104, np.nan, np.nan])


def test_a_sensor_without_systematic_error_cannot_be_talked_into_one() -> None:
    sure = DepthOffset.expected(0.0)
    assert sure.information >= 1e20
    np.testing.assert_array_equal(sure.correct(np.array([0.5, np.nan])), [0.5, np.nan])
