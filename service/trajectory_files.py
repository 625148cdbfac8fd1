"""Reading trajectories: TUM, KITTI and EuRoC files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.frontend import se3
from seamark.service.stamps import parse_stamp, running_stamp
from seamark.service.types import Trajectory

Matrix = NDArray[np.float64]

# Rotations written with few digits are still meant as rotations.
DETERMINANT_TOLERANCE = 0.01
# Beyond it squares lose what counts: no camera was ever there.
FARTHEST_M = 1e12


class TrajectoryError(SeamarkError):
    """A file is no trajectory."""


def load_trajectory(path: Path, times: Path | None = None) -> Trajectory:
    """Read a trajectory in TUM, KITTI or EuRoC form, told apart by the number of columns; raises TrajectoryError."""
    columns = len(_rows(path)[0][1])
    if columns == 8:
        return load_tum(path)
    if columns == 12:
        return load_kitti(path, times)
    if columns >= 17:
        return load_euroc(path)
    raise TrajectoryError(f"{path} has {columns} columns; TUM has 8, KITTI 12 and EuRoC ground truth 17")


def load_tum(path: Path) -> Trajectory:
    """Read ``stamp tx ty tz qx qy qz qw`` rows (stamps in seconds); raises TrajectoryError with file and line."""
    rows = _rows(path)
    stamps, values = _stamps(path, rows, 8), _numbers(path, rows, 8)
    return _trajectory(stamps, values[:, 1:4], values[:, 4:8])


def load_euroc(path: Path) -> Trajectory:
    """Read the ground truth of an EuRoC body: ``ns,px,py,pz,qw,qx,qy,qz,...``; raises TrajectoryError."""
    rows = _rows(path)
    values = _numbers(path, rows, 8)
    try:
        stamps = np.array([int(row[0]) for _, row in rows], np.int64)
    except (ValueError, OverflowError) as error:
        raise TrajectoryError(f"{path}: stamps must be whole nanoseconds ({error})") from error
    return _trajectory(stamps, values[:, 1:4], values[:, [5, 6, 7, 4]])


def load_kitti(path: Path, times: Path | None = None, rate_hz: float = 10.0) -> Trajectory:
    """Read rows of 3x4 matrices and their times (seconds; else ``rate_hz``); raises TrajectoryError."""
    rows = _rows(path)
    values = _numbers(path, rows, 12)
    if times is None:
        stamps = np.array([running_stamp(i, rate_hz) for i in range(len(rows))], np.int64)
    else:
        stamps = load_times(times)
    if len(stamps) != len(rows):
        raise TrajectoryError(f"{path} has {len(rows)} poses but {times} has {len(stamps)} times")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :] = values.reshape(-1, 3, 4)
    sane = T[:, :3, :3].copy()
    sane[~(np.abs(values) < FARTHEST_M).all(axis=1)] = 0
    rigid = np.abs(np.linalg.det(sane) - 1) < DETERMINANT_TOLERANCE
    if not rigid.all():
        raise TrajectoryError(f"{path}, line {rows[int(np.argmin(rigid))][0]}: this is not a rigid motion")
    return _sorted(stamps, np.stack([se3.orthonormalise(one) for one in T]))


def load_times(path: Path) -> NDArray[np.int64]:
    """Read one stamp in seconds per line as (N,) int64 nanoseconds; raises TrajectoryError."""
    return _stamps(path, _rows(path), 1)


def _trajectory(stamps: NDArray[np.int64], positions: Matrix, quaternions: Matrix) -> Trajectory:
    good = (np.linalg.norm(quaternions, axis=1) > 0.5) & (np.abs(positions) < FARTHEST_M).all(axis=1)  # NaN is not
    T = np.tile(np.eye(4), (int(good.sum()), 1, 1))
    T[:, :3, :3] = se3.from_quaternion(quaternions[good])
    T[:, :3, 3] = positions[good]
    return _sorted(stamps[good], T)


def _sorted(stamps: NDArray[np.int64], T: Matrix) -> Trajectory:
    # Real files repeat stamps now and then; the first of them counts.
    unique, first = np.unique(stamps, return_index=True)
    return Trajectory(unique, T[first])


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path} cannot be read as a trajectory: {error}") from error
    lines = ((number, line.split("#")[0].replace(",", " ").split()) for number, line in enumerate(text.splitlines(), 1))
    rows = [(number, fields) for number, fields in lines if fields]
    if not rows:
        raise TrajectoryError(f"{path} holds no poses")
    return rows


def _numbers(path: Path, rows: list[tuple[int, list[str]]], count: int) -> Matrix:
    out = np.empty((len(rows), count))
    for k, (number, fields) in enumerate(rows):
        if len(fields) < count:
            raise TrajectoryError(f"{path}, line {number}: {count} numbers were expected, not {len(fields)}")
        try:
            out[k] = [float(field) for field in fields[:count]]
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {number}: {count} numbers were expected ({error})") from error
    return out


def _stamps(path: Path, rows: list[tuple[int, list[str]]], count: int) -> NDArray[np.int64]:
    out = np.empty(len(rows), np.int64)
    for k, (number, fields) in enumerate(rows):
        if len(fields) < count:
            raise TrajectoryError(f"{path}, line {number}: {count} numbers were expected, not {len(fields)}")
        try:
            out[k] = parse_stamp(fields[0])
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {number}: {error}") from error
    return out
