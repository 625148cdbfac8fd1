"""Sequences as folders in the layouts of public data sets: TUM RGB-D, EuRoC ASL, KITTI odometry.

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; M. Burri et al., "The EuRoC micro
aerial vehicle datasets", IJRR 2016; A. Geiger et al., "Are we ready for autonomous driving?", CVPR 2012. Pictures are
in colour in all of them. Readings of the motion sensors lie in mav0 (EuRoC) or in imu.csv, wheels.csv and gps.csv.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import folder
from seamark.datasets_synth.motion_sensors import GpsReadings, ImuReadings, Motion, MotionErrors, WheelReadings
from seamark.datasets_synth.sensor import CodedFrame
from seamark.datasets_synth.sequence import GroundTruth
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig
from seamark.frontend.types import Mode

PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
TRUTH_HEADER = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
WHEELS_HEADER = "#timestamp [ns],front_left [ticks],front_right [ticks],rear_left [ticks],rear_right [ticks]"
GPS_HEADER = "#timestamp [ns],x [m],y [m],z [m]"


@dataclass(frozen=True, eq=False)
class Recording:
    """All of a sequence but its pictures; ``title`` says where it comes from."""

    title: str
    mode: Mode
    rig: Rig
    truth: GroundTruth
    motion: Motion
    errors: MotionErrors
    imu: ImuReadings
    wheels: WheelReadings
    gps: GpsReadings


@dataclass(frozen=True)
class Layout:
    """How one kind of folder is written: which modes it can carry, its frames, and what comes after them.

    ``frame`` returns file names, relative to the folder, with their content; ``finish`` writes the rest.
    """

    modes: tuple[Mode, ...]
    distortion: bool
    frame: Callable[[CodedFrame, int], dict[str, bytes]]
    finish: Callable[[Path, Recording], None]


def require(name: str, mode: Mode, rig: Rig) -> Layout:
    """Return the layout; raises SeamarkError where there is none or where it cannot carry these sensors."""
    if name not in LAYOUTS:
        raise SeamarkError(f"there is no layout {name!r}; there are {', '.join(LAYOUTS)}")
    layout = LAYOUTS[name]
    if mode not in layout.modes:
        raise SeamarkError(f"layout {name} carries {' or '.join(layout.modes)}, not sensors={mode}")
    if rig.cam0.distorted and not layout.distortion:
        raise SeamarkError(f"layout {name} knows no distortion; take camera=ideal, or another layout")
    return layout


def _png(picture: bytes) -> bytes:
    """Return a picture as PNG, whatever it was coded as."""
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    return bytes(cv2.imencode(".png", image, PNG_FAST)[1])


def _table(file: Path, header: str, stamps_ns: NDArray[np.int64], values: NDArray[np.generic]) -> None:
    """Write comma-separated rows of a stamp and values (M, D): whole numbers as they are, others with 9 digits."""
    whole = np.issubdtype(values.dtype, np.integer)
    lines = [header]
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        lines.append(",".join([str(stamp), *(str(number) if whole else f"{number:.9g}" for number in row)]))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _fixes(gps: GpsReadings) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps and positions without outages."""
    known = np.isfinite(gps.positions[:, 0])
    return gps.stamps_ns[known], gps.positions[known]


def _side_tables(root: Path, recording: Recording) -> None:
    imu = recording.imu
    _table(root / "imu.csv", IMU_HEADER, imu.stamps_ns, np.hstack([imu.gyro, imu.accelerometer]))
    _table(root / "wheels.csv", WHEELS_HEADER, recording.wheels.stamps_ns, recording.wheels.ticks)
    _table(root / "gps.csv", GPS_HEADER, *_fixes(recording.gps))


def _tum_frame(coded: CodedFrame, stamp_ns: int) -> dict[str, bytes]:
    picture, _, depth = folder.names(coded.index)
    return {picture: coded.left, **({depth: coded.depth} if coded.depth else {})}


def _tum_finish(root: Path, recording: Recording) -> None:
    folder.finish(root, recording.title, recording.mode, recording.rig, recording.truth)
    _side_tables(root, recording)


def _euroc_frame(coded: CodedFrame, stamp_ns: int) -> dict[str, bytes]:
    files = {f"mav0/cam0/data/{stamp_ns}.png": _png(coded.left)}
    if coded.right:
        files[f"mav0/cam1/data/{stamp_ns}.png"] = _png(coded.right)
    return files


def _pose_yaml(T: NDArray[np.float64]) -> list[str]:
    numbers = ", ".join(repr(number) for number in T.ravel().tolist())
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{numbers}]"]


def _camera_yaml(camera: Camera, T_body_cam: NDArray[np.float64], rate_hz: float) -> list[str]:
    distortion = list(camera.distortion) or [0.0, 0.0, 0.0, 0.0]
    return [
        "sensor_type: camera",
        *_pose_yaml(T_body_cam),
        f"rate_hz: {rate_hz:.6g}",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: [{camera.fx!r}, {camera.fy!r}, {camera.cx!r}, {camera.cy!r}]",
        "distortion_model: radial-tangential",
        f"distortion_coefficients: {distortion!r}",
    ]


def _imu_yaml(errors: MotionErrors) -> list[str]:
    imu = errors.imu
    return [
        "sensor_type: imu",
        *_pose_yaml(np.eye(4)),
        f"rate_hz: {imu.rate_hz:.6g}",
        f"gyroscope_noise_density: {imu.gyro_noise_rad_s_per_sqrt_hz!r}",
        f"gyroscope_random_walk: {imu.gyro_walk_rad_s2_per_sqrt_hz!r}",
        f"accelerometer_noise_density: {imu.accelerometer_noise_m_s2_per_sqrt_hz!r}",
        f"accelerometer_random_walk: {imu.accelerometer_walk_m_s3_per_sqrt_hz!r}",
    ]


def _write(file: Path, lines: list[str]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _euroc_finish(root: Path, recording: Recording) -> None:
    """The body is the inertial unit: x forward, y left, z up, in the place of cam0."""
    mav, rig, truth = root / "mav0", recording.rig, recording.truth
    rate_hz = 1e9 / float(np.median(np.diff(truth.stamps_ns)))
    T_body_cam = se3.T_WORLD_LEVEL_CAM
    _write(mav / "cam0" / "sensor.yaml", _camera_yaml(rig.cam0, T_body_cam, rate_hz))
    cameras = ["cam0"]
    if rig.cam1 is not None and rig.T_cam0_cam1 is not None:
        _write(mav / "cam1" / "sensor.yaml", _camera_yaml(rig.cam1, T_body_cam @ rig.T_cam0_cam1, rate_hz))
        cameras.append("cam1")
    for camera in cameras:
        rows = [f"{stamp},{stamp}.png" for stamp in truth.stamps_ns.tolist()]
        _write(mav / camera / "data.csv", ["#timestamp [ns],filename", *rows])
    imu = recording.imu
    _write(mav / "imu0" / "sensor.yaml", _imu_yaml(recording.errors))
    _table(mav / "imu0" / "data.csv", IMU_HEADER, imu.stamps_ns, np.hstack([imu.gyro, imu.accelerometer]))
    _table(mav / "wheels0" / "data.csv", WHEELS_HEADER, recording.wheels.stamps_ns, recording.wheels.ticks)
    _table(mav / "gps0" / "data.csv", GPS_HEADER, *_fixes(recording.gps))
    _euroc_truth(mav / "state_groundtruth_estimate0", recording)
    _write(mav / "body.yaml", [f"comment: {recording.title}"])


def _euroc_truth(root: Path, recording: Recording) -> None:
    """Write the true states at the stamps of the inertial unit and of the frames; the latter are exact."""
    imu, truth = recording.imu, recording.truth
    stamps = np.union1d(imu.stamps_ns, truth.stamps_ns)
    T_world_body = recording.motion.poses(stamps)
    T_world_body[np.searchsorted(stamps, truth.stamps_ns)] = truth.T_world_cam @ se3.inverse(se3.T_WORLD_LEVEL_CAM)
    quaternions = np.stack([se3.to_quaternion(T[:3, :3]) for T in T_world_body])[:, [3, 0, 1, 2]]
    biases = [
        np.interp(stamps - stamps[0], imu.stamps_ns - stamps[0], column)
        for column in (*imu.gyro_bias.T, *imu.accelerometer_bias.T)
    ]
    velocity = recording.motion.rates(stamps)[1]
    values = np.hstack([T_world_body[:, :3, 3], quaternions, velocity, np.stack(biases, axis=1)])
    _table(root / "data.csv", TRUTH_HEADER, stamps, values)
    _write(root / "sensor.yaml", ["sensor_type: visual-inertial", *_pose_yaml(np.eye(4))])


def _kitti_frame(coded: CodedFrame, stamp_ns: int) -> dict[str, bytes]:
    files = {f"image_0/{coded.index:06d}.png": _png(coded.left)}
    if coded.right:
        files[f"image_1/{coded.index:06d}.png"] = _png(coded.right)
    return files


def _kitti_finish(root: Path, recording: Recording) -> None:
    """Poses are in the frame of the first camera and times since the first frame, as in the data set."""
    rig, truth = recording.rig, recording.truth
    camera = rig.cam0
    shift = 0.0 if rig.T_cam0_cam1 is None else -camera.fx * float(rig.T_cam0_cam1[0, 3])
    rows = []
    for number, across in (("P0", 0.0), *((("P1", shift),) if rig.cam1 is not None else ())):
        P = [camera.fx, 0.0, camera.cx, across, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        rows.append(f"{number}: " + " ".join(f"{value:.12e}" for value in P))
    _write(root / "calib.txt", rows)
    since = (truth.stamps_ns - truth.stamps_ns[0]).tolist()
    _write(root / "times.txt", [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in since])
    T_first_cam = se3.inverse(truth.T_world_cam[0]) @ truth.T_world_cam
    _write(root / "poses.txt", [" ".join(f"{value:.9e}" for value in T[:3].ravel()) for T in T_first_cam])
    _side_tables(root, recording)


LAYOUTS = {
    "tum": Layout((Mode.RGBD, Mode.MONO), True, _tum_frame, _tum_finish),
    "euroc": Layout((Mode.STEREO, Mode.MONO), True, _euroc_frame, _euroc_finish),
    "kitti": Layout((Mode.STEREO, Mode.MONO), False, _kitti_frame, _kitti_finish),
}
