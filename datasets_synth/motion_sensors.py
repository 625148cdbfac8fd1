"""What wheel encoders, an inertial unit and a satellite receiver on the camera's trajectory would read.

The body frame is that of REP-103 (x forward, y left, z up) with its origin in the camera: T_body_cam is
``se3.T_WORLD_LEVEL_CAM``. The truth is the smooth motion through the poses (``spline.through_poses``), one for each
part between teleports; within a teleport the body rests. Every sensor has systematic errors, drawn once from the seed,
and random ones. The errors of the inertial unit are those of IEEE Std 952: white noise and a bias that walks.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth.spline import PoseSpline, through_poses
from seamark.frontend import se3

Array = NDArray[np.float64]
GRAVITY_M_S2 = 9.81
NANOSECONDS = 1e9


@dataclass(frozen=True)
class ImuErrors:
    """An inertial unit; noise and walk are densities, start bias and scale one sigma of what is drawn per axis."""

    rate_hz: float = 200.0
    gyro_noise_rad_s_per_sqrt_hz: float = 0.0
    gyro_walk_rad_s2_per_sqrt_hz: float = 0.0
    gyro_start_bias_rad_s: float = 0.0
    gyro_scale: float = 0.0
    accelerometer_noise_m_s2_per_sqrt_hz: float = 0.0
    accelerometer_walk_m_s3_per_sqrt_hz: float = 0.0
    accelerometer_start_bias_m_s2: float = 0.0
    accelerometer_scale: float = 0.0


@dataclass(frozen=True)
class WheelErrors:
    """Four mecanum wheels, because they can follow every motion in the plane, sway and turns on the spot included.

    ``reach_m`` is half the wheel base plus half the track. ``scale`` (per wheel) and ``reach_error_m`` are one sigma of
    systematic errors; ``slip_per_sqrt_m`` is the random error of each wheel in m after one metre. Counts are whole.
    """

    rate_hz: float = 50.0
    reach_m: float = 0.45
    ticks_per_m: float = 5000.0
    scale: float = 0.0
    reach_error_m: float = 0.0
    slip_per_sqrt_m: float = 0.0


@dataclass(frozen=True)
class GpsErrors:
    """A satellite receiver: white noise, an offset that walks back to zero with a time constant, and outages.

    ``offset_m`` is one sigma of the offset per axis at any time, ``offset_time_s`` how long it keeps; vertical errors
    are ``vertical_factor`` times larger. Outages come ``outages_per_min`` times and last ``outage_s`` on average.
    """

    rate_hz: float = 5.0
    noise_m: float = 0.0
    offset_m: float = 0.0
    offset_time_s: float = 60.0
    vertical_factor: float = 1.8
    outages_per_min: float = 0.0
    outage_s: float = 4.0


@dataclass(frozen=True)
class MotionErrors:
    """The three sensors of one quality."""

    imu: ImuErrors = field(default_factory=ImuErrors)
    wheels: WheelErrors = field(default_factory=WheelErrors)
    gps: GpsErrors = field(default_factory=GpsErrors)


MODELS = {
    "ideal": MotionErrors(),
    "mild": MotionErrors(
        ImuErrors(200.0, 1.7e-4, 2e-5, 0.003, 0.0005, 2e-3, 3e-3, 0.03, 0.0005),
        WheelErrors(50.0, 0.45, 5000.0, 0.003, 0.004, 0.005),
        GpsErrors(5.0, 0.3, 0.8, 60.0, 1.8, 0.5, 4.0),
    ),
    "cheap": MotionErrors(
        ImuErrors(200.0, 1.2e-3, 1.5e-4, 0.02, 0.003, 8e-3, 1e-2, 0.15, 0.003),
        WheelErrors(50.0, 0.45, 1000.0, 0.012, 0.012, 0.02),
        GpsErrors(1.0, 1.2, 2.5, 40.0, 1.8, 1.5, 8.0),
    ),
}


@dataclass(frozen=True, eq=False)
class ImuReadings:
    """``stamps_ns`` (M,); ``gyro`` rad/s and ``accelerometer`` m/s^2 (specific force), (M, 3) in the body frame.

    ``gyro_bias`` and ``accelerometer_bias`` (M, 3) are the true biases, ``velocity`` (M, 3) the true one in the world.
    """

    stamps_ns: NDArray[np.int64]
    gyro: Array
    accelerometer: Array
    gyro_bias: Array
    accelerometer_bias: Array
    velocity: Array


@dataclass(frozen=True, eq=False)
class WheelReadings:
    """``stamps_ns`` (M,) and ``ticks`` (M, 4) since the first: front left, front right, rear left, rear right."""

    stamps_ns: NDArray[np.int64]
    ticks: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class GpsReadings:
    """``stamps_ns`` (M,), ``positions`` (M, 3) m in the world, NaN in an outage, and their ``offsets`` (M, 3) m."""

    stamps_ns: NDArray[np.int64]
    positions: Array
    offsets: Array


class Motion:
    """The smooth motion of the body through the poses of the camera; ``breaks`` are the frames after a teleport."""

    def __init__(self, stamps_ns: NDArray[np.int64], T_world_cam: Array, breaks: list[int] | None = None) -> None:
        ends = [0, *(breaks or []), len(stamps_ns)]
        if len(stamps_ns) != len(T_world_cam) or np.any(np.diff(ends) < 1):
            raise SeamarkError(
                f"a motion needs as many stamps as poses, and teleports {breaks or []} between them; there are "
                f"{len(stamps_ns)} stamps and {len(T_world_cam)} poses"
            )
        self.stamps_ns = stamps_ns
        T_world_body = T_world_cam @ se3.inverse(se3.T_WORLD_LEVEL_CAM)
        since = (stamps_ns - stamps_ns[0]) / NANOSECONDS
        self._parts: list[tuple[float, float, PoseSpline]] = []
        for begin, end in itertools.pairwise(ends):
            knots, poses = since[begin:end], T_world_body[begin:end]
            if end - begin == 1:  # it stands there and is carried on
                knots, poses = np.array([knots[0], knots[0] + 1]), np.repeat(poses, 2, axis=0)
            spline = through_poses(knots, poses)
            self._parts.append((float(since[begin]), float(since[end - 1]), spline))

    def stamps(self, rate_hz: float) -> NDArray[np.int64]:
        """Return stamps (M,) at ``rate_hz`` from the first frame to the last."""
        count = int((self.stamps_ns[-1] - self.stamps_ns[0]) / NANOSECONDS * rate_hz + 1e-6) + 1
        steps: NDArray[np.int64] = np.rint(np.arange(count) * (NANOSECONDS / rate_hz)).astype(np.int64)
        return self.stamps_ns[0] + steps

    def _numbered(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
        since = (stamps_ns - self.stamps_ns[0]) / NANOSECONDS
        begins = np.array([begin for begin, _, _ in self._parts])
        return since, np.clip(np.searchsorted(begins, since, "right") - 1, 0, len(begins) - 1)

    def poses(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return T_world_body (M, 4, 4)."""
        since, number = self._numbered(stamps_ns)
        out = np.empty((len(since), 4, 4))
        for k, (begin, end, spline) in enumerate(self._parts):
            out[number == k] = spline.poses(np.clip(since[number == k], begin, end))
        return out

    def rates(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Return angular velocity (body, rad/s), velocity (world, m/s), acceleration (world, m/s^2), (M, 3) each."""
        since, number = self._numbered(stamps_ns)
        out = np.zeros((3, len(since), 3))
        for k, (_, end, spline) in enumerate(self._parts):
            inside = (number == k) & (since <= end)
            times = since[inside]
            values = (spline.angular_velocity(times), spline.position(times, 1), spline.position(times, 2))
            out[:, inside] = np.stack(values)
        return out[0], out[1], out[2]

    def within(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number (M,) of the part between teleports."""
        return self._numbered(stamps_ns)[1]


def read_imu(motion: Motion, errors: ImuErrors, seed: int) -> ImuReadings:
    """Return what an inertial unit in the body's origin reads."""
    rng = np.random.default_rng([seed, 0x1111])
    stamps = motion.stamps(errors.rate_hz)
    turning, velocity, acceleration = motion.rates(stamps)
    R = motion.poses(stamps)[:, :3, :3]
    force = np.einsum("nji,nj->ni", R, acceleration + np.array([0, 0, GRAVITY_M_S2]))
    gyro, gyro_bias = _inertial(
        rng,
        turning,
        errors.rate_hz,
        errors.gyro_noise_rad_s_per_sqrt_hz,
        errors.gyro_walk_rad_s2_per_sqrt_hz,
        errors.gyro_start_bias_rad_s,
        errors.gyro_scale,
    )
    accelerometer, accelerometer_bias = _inertial(
        rng,
        force,
        errors.rate_hz,
        errors.accelerometer_noise_m_s2_per_sqrt_hz,
        errors.accelerometer_walk_m_s3_per_sqrt_hz,
        errors.accelerometer_start_bias_m_s2,
        errors.accelerometer_scale,
    )
    return ImuReadings(stamps, gyro, accelerometer, gyro_bias, accelerometer_bias, velocity)


def _inertial(
    rng: np.random.Generator, truth: Array, rate_hz: float, noise: float, walk: float, start_bias: float, scale: float
) -> tuple[Array, Array]:
    """Return readings of the truth (M, 3) and the bias (M, 3) in them."""
    start, factors = start_bias * rng.standard_normal(3), 1 + scale * rng.standard_normal(3)
    steps = np.cumsum(rng.standard_normal(truth.shape), axis=0)
    bias = start + walk / np.sqrt(rate_hz) * steps
    white = noise * np.sqrt(rate_hz) * rng.standard_normal(truth.shape)
    return truth * factors + bias + white, bias


def _wheel_matrix(reach_m: float) -> Array:
    """Return (4, 3): metres rolled by each wheel per metre ahead, metre to the left and radian to the left."""
    return np.array([[1, -1, -reach_m], [1, 1, reach_m], [1, 1, -reach_m], [1, -1, reach_m]], np.float64)


def _planar(T_world_body: Array) -> tuple[Array, Array]:
    """Return places (M, 2) and continuous headings (M,) of the body in the plane."""
    heading = np.unwrap(np.arctan2(T_world_body[:, 1, 0], T_world_body[:, 0, 0]))
    return T_world_body[:, :2, 3], heading


def read_wheels(motion: Motion, errors: WheelErrors, seed: int) -> WheelReadings:
    """Return what the encoders of a platform count that carries the camera; it rolls in the plane of the world."""
    rng = np.random.default_rng([seed, 0x2222])
    stamps = motion.stamps(errors.rate_hz)
    place, heading = _planar(motion.poses(stamps))
    middle = 0.5 * (heading[1:] + heading[:-1])
    step = np.diff(place, axis=0)
    ahead = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    left = np.cos(middle) * step[:, 1] - np.sin(middle) * step[:, 0]
    moved = np.stack([ahead, left, np.diff(heading)], axis=1)
    moved[np.diff(motion.within(stamps)) != 0] = 0  # who is carried rolls nowhere
    factors = 1 + errors.scale * rng.standard_normal(4)
    rolled = moved @ _wheel_matrix(errors.reach_m + errors.reach_error_m * rng.standard_normal()).T * factors
    rolled += errors.slip_per_sqrt_m * np.sqrt(np.abs(rolled)) * rng.standard_normal(rolled.shape)
    total = np.concatenate([np.zeros((1, 4)), np.cumsum(rolled, axis=0)])
    return WheelReadings(stamps, np.rint(total * errors.ticks_per_m).astype(np.int64))


def dead_reckoning(readings: WheelReadings, errors: WheelErrors) -> Array:
    """Return T_start_body (M, 4, 4) in the plane, as one who knows the nominal platform computes it from the ticks."""
    moved = np.diff(readings.ticks, axis=0) / errors.ticks_per_m @ np.linalg.pinv(_wheel_matrix(errors.reach_m)).T
    heading = np.concatenate([[0], np.cumsum(moved[:, 2])])
    middle = 0.5 * (heading[1:] + heading[:-1])
    out = np.tile(np.eye(4), (len(heading), 1, 1))
    out[1:, 0, 3] = np.cumsum(np.cos(middle) * moved[:, 0] - np.sin(middle) * moved[:, 1])
    out[1:, 1, 3] = np.cumsum(np.sin(middle) * moved[:, 0] + np.cos(middle) * moved[:, 1])
    out[:, 0, 0], out[:, 0, 1] = np.cos(heading), -np.sin(heading)
    out[:, 1, 0], out[:, 1, 1] = np.sin(heading), np.cos(heading)
    return out


def read_gps(motion: Motion, errors: GpsErrors, seed: int) -> GpsReadings:
    """Return what a satellite receiver in the body's origin says."""
    rng = np.random.default_rng([seed, 0x3333])
    stamps = motion.stamps(errors.rate_hz)
    sizes = np.array([1, 1, errors.vertical_factor])
    keep = float(np.exp(-1 / (errors.rate_hz * errors.offset_time_s)))
    offsets = np.empty((len(stamps), 3))
    offset = rng.standard_normal(3)
    for k, kick in enumerate(rng.standard_normal((len(stamps), 3))):  # a process of Gauss and Markov
        offsets[k] = offset
        offset = keep * offset + np.sqrt(1 - keep**2) * kick
    offsets *= errors.offset_m * sizes
    positions = motion.poses(stamps)[:, :3, 3] + offsets
    positions += errors.noise_m * sizes * rng.standard_normal(positions.shape)
    begins = rng.random(len(stamps)) < errors.outages_per_min / 60 / errors.rate_hz
    for k in np.flatnonzero(begins).tolist():
        positions[k : k + max(1, round(rng.exponential(errors.outage_s) * errors.rate_hz))] = np.nan
    return GpsReadings(stamps, positions, offsets)
