"""Encoders, inertial unit and satellite receiver: without errors they give the trajectory back, with them they err."""

from dataclasses import replace

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import specification, trajectory
from seamark.datasets_synth.motion_sensors import (
    GRAVITY_M_S2,
    MODELS,
    GpsErrors,
    ImuErrors,
    ImuReadings,
    Motion,
    WheelErrors,
    dead_reckoning,
    read_gps,
    read_imu,
    read_wheels,
)
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.trajectories import make_trajectory, teleports
from seamark.frontend import se3

FPS = 15.0
RING = Route("ring", np.array([[-6, -4, 1.3], [6, -4, 1.3], [6, 4, 1.3], [-6, 4, 1.3]], float), True, 1.2, 1.4)


def _motion(kind: str, frames: int = 500) -> Motion:
    poses = make_trajectory(kind, RING, frames, FPS, 3)
    return Motion(trajectory.stamps(frames, FPS), poses, teleports(poses, FPS, 5.0))


def _integrate(motion: Motion, readings: ImuReadings, end: int | None = None) -> np.ndarray:
    """The positions (M, 3) by the trapezoid rule, from the true first pose and velocity."""
    T = motion.poses(readings.stamps_ns[:1])[0]
    R, position, velocity = T[:3, :3], T[:3, 3], readings.velocity[0]
    h = np.diff(readings.stamps_ns) / 1e9
    gravity = np.array([0, 0, -GRAVITY_M_S2])
    out = [position]
    for k in range(len(h) if end is None else end):
        R_next = R @ se3.exp_rotation(0.5 * (readings.gyro[k] + readings.gyro[k + 1]) * h[k])
        a, b = R @ readings.accelerometer[k] + gravity, R_next @ readings.accelerometer[k + 1] + gravity
        position = position + velocity * h[k] + (2 * a + b) * h[k] ** 2 / 6
        velocity = velocity + 0.5 * (a + b) * h[k]
        R = R_next
        out.append(position)
    return np.stack(out)


@pytest.mark.parametrize("kind", ["loop", "hand_held", "six_dof", "pure_rotation"])
def test_an_ideal_imu_integrates_back_to_the_trajectory(kind: str) -> None:
    motion = _motion(kind)
    readings = read_imu(motion, ImuErrors(), 0)
    error = np.linalg.norm(_integrate(motion, readings) - motion.poses(readings.stamps_ns)[:, :3, 3], axis=1)
    assert 0 < error.max() < 0.03  # after 33 s and some 30 m


def test_an_ideal_imu_integrates_back_to_the_poses_of_the_world_loop() -> None:
    poses = specification.parse("loop,frames=300").poses()
    motion = Motion(trajectory.stamps(300, 15.0), poses)
    readings = read_imu(motion, ImuErrors(), 0)
    error = np.linalg.norm(_integrate(motion, readings)[-1] - poses[-1, :3, 3])
    assert 0 < error < 0.1


def test_a_standing_imu_feels_gravity() -> None:
    poses = np.repeat(trajectory.look(np.zeros(3), 0.7, 0.3)[None], 30, axis=0)
    readings = read_imu(Motion(trajectory.stamps(30, FPS), poses), ImuErrors(), 0)
    assert len(readings.gyro) == int(29 / FPS * 200) + 1
    assert np.abs(readings.gyro).max() < 1e-9
    nose_down = GRAVITY_M_S2 * np.array([-np.sin(0.3), 0, np.cos(0.3)])
    assert np.allclose(readings.accelerometer, nose_down, atol=1e-6)


def test_imu_errors_are_as_large_as_they_say() -> None:
    motion = _motion("stop_and_go")
    errors = MODELS["cheap"].imu
    ideal, real = read_imu(motion, ImuErrors(), 0), read_imu(motion, replace(errors, gyro_scale=0.0), 1)
    noise = real.gyro - ideal.gyro - real.gyro_bias
    assert noise.std() == pytest.approx(errors.gyro_noise_rad_s_per_sqrt_hz * np.sqrt(200), rel=0.03)
    starts = np.stack([read_imu(motion, errors, seed).accelerometer_bias[0] for seed in range(40)])
    assert starts.std() == pytest.approx(errors.accelerometer_start_bias_m_s2, rel=0.2)
    walks = np.stack([np.ptp(read_imu(motion, errors, seed).gyro_bias[[0, -1]], axis=0) for seed in range(40)])
    expected = errors.gyro_walk_rad_s2_per_sqrt_hz * np.sqrt(499 / FPS)
    assert np.sqrt(np.mean(walks**2)) == pytest.approx(expected, rel=0.2)
    drift = np.linalg.norm(_integrate(motion, real)[-1] - motion.poses(real.stamps_ns)[-1, :3, 3])
    assert 10 < drift < 5000  # 0.02 rad/s of bias leave nothing after half a minute


@pytest.mark.parametrize("kind", ["loop", "pure_rotation", "stop_and_go", "second_traversal"])
def test_ideal_encoders_integrate_back_to_the_trajectory(kind: str) -> None:
    motion = _motion(kind)
    errors = WheelErrors()
    readings = read_wheels(motion, errors, 0)
    truth = motion.poses(readings.stamps_ns)
    way = dead_reckoning(readings, errors)
    yaw = np.arctan2(truth[0, 1, 0], truth[0, 0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    xy = way[:, :2, 3] @ np.array([[c, s], [-s, c]]) + truth[0, :2, 3]
    error = np.linalg.norm(xy - truth[:, :2, 3], axis=1)
    assert 0 < error.max() < 0.05  # quantisation only


def test_encoders_err_by_scale_and_slip() -> None:
    motion = _motion("loop")
    errors = WheelErrors(scale=0.01)
    truth = motion.poses(motion.stamps(errors.rate_hz))
    length = np.linalg.norm(np.diff(truth[:, :2, 3], axis=0), axis=1).sum()
    shares = []
    for seed in range(20):
        way = dead_reckoning(read_wheels(motion, errors, seed), errors)
        shares.append(np.linalg.norm(np.diff(way[:, :2, 3], axis=0), axis=1).sum() / length - 1)
    assert 0.002 < np.std(shares) < 0.01  # the mean of four wheels
    slipping = WheelErrors(slip_per_sqrt_m=0.02)
    ideal = read_wheels(motion, WheelErrors(), 0).ticks[-1] / 5000
    spread = np.std([read_wheels(motion, slipping, seed).ticks[-1] / 5000 - ideal for seed in range(40)])
    assert spread == pytest.approx(0.02 * np.sqrt(length), rel=0.25)


def test_a_carried_platform_rolls_nowhere() -> None:
    motion = _motion("kidnap")
    readings = read_wheels(motion, WheelErrors(), 0)
    assert np.abs(np.diff(readings.ticks, axis=0)).max() < 2.5 * 1.4 / 50 * 5000
    imu = read_imu(motion, ImuErrors(), 0)
    assert np.abs(imu.accelerometer).max() < 15
    positions = read_gps(motion, GpsErrors(), 0).positions
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() > 3


def test_an_ideal_receiver_is_exact_and_a_cheap_one_is_off_and_out() -> None:
    motion = _motion("loop")
    ideal = read_gps(motion, GpsErrors(), 0)
    assert np.allclose(ideal.positions, motion.poses(ideal.stamps_ns)[:, :3, 3])
    errors = replace(MODELS["cheap"].gps, outages_per_min=6.0)
    missing, offsets, noise = [], [], []
    for seed in range(40):
        readings = read_gps(motion, errors, seed)
        missing.append(np.isnan(readings.positions[:, 0]).mean())
        offsets.append(readings.offsets[:, :2])
        rest = readings.positions - readings.offsets - motion.poses(readings.stamps_ns)[:, :3, 3]
        noise.append(rest[~np.isnan(rest[:, 0])][:, :2].ravel())
    assert 0.15 < np.mean(missing) < 0.7
    assert np.std(np.concatenate(offsets)) == pytest.approx(errors.offset_m, rel=0.3)
    assert np.std(np.concatenate(noise)) == pytest.approx(errors.noise_m, rel=0.1)
    steps = np.diff(offsets[0], axis=0)
    assert steps.std() < 0.5 * errors.offset_m  # it walks, it does not jump


def test_same_seed_same_bits() -> None:
    motion = _motion("loop", 100)
    for read, errors in ((read_imu, "imu"), (read_wheels, "wheels"), (read_gps, "gps")):
        first, second, other = (read(motion, getattr(MODELS["cheap"], errors), seed) for seed in (1, 1, 2))
        parts = [name for name in vars(first) if name not in ("stamps_ns", "velocity")]
        for name in parts:
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
        assert any(getattr(first, name).tobytes() != getattr(other, name).tobytes() for name in parts)


def test_teleports_lie_between_frames() -> None:
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[2:, 0, 3], poses[3:, 0, 3] = 10.0, 20.0
    motion = Motion(trajectory.stamps(5, FPS), poses, [2, 3])  # one frame alone between two teleports
    assert np.allclose(motion.poses(motion.stamps_ns), poses @ se3.inverse(se3.T_WORLD_LEVEL_CAM))
    assert np.abs(motion.rates(motion.stamps(200.0))[1]).max() < 1e-9
    with pytest.raises(SeamarkError, match="teleports"):
        Motion(trajectory.stamps(5, FPS), poses, [2, 2])
    with pytest.raises(SeamarkError, match="5 stamps and 4 poses"):
        Motion(trajectory.stamps(5, FPS), poses[:4])
