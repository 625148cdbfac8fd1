"""Calibration files: our own calib.yaml, EuRoC's sensor.yaml, KITTI's calib.txt."""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from seamark.frontend import se3
from seamark.frontend.camera import CalibrationError, Camera, Rig
from seamark.service.validation import sentence

Matrix = NDArray[np.float64]
Model = TypeVar("Model", bound=BaseModel)

# Rotations written with 4 or 5 digits are still meant as rotations.
ROTATION_TOLERANCE = 1e-3
BASELINE_TOLERANCE = 0.01


def _sixteen(value: Any) -> Any:
    """Flatten a nested 4x4 list."""
    if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value):
        return [number for row in value for number in row]
    return value


class _CalibrationFile(BaseModel):
    """The keys of calib.yaml."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    model: Literal["pinhole"]
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion: list[float] = Field(default_factory=list)
    depth_factor: float = Field(default=1000.0, gt=0)
    baseline: float | None = Field(default=None, gt=0)
    T_cam0_cam1: Annotated[list[float], Field(min_length=16, max_length=16), BeforeValidator(_sixteen)] | None = None


class _Pose(BaseModel):
    """A matrix as EuRoC writes it."""

    cols: Literal[4]
    rows: Literal[4]
    data: list[float] = Field(min_length=16, max_length=16)


class _EurocSensor(BaseModel):
    """The keys of an EuRoC camera that matter here; the files carry many others."""

    T_BS: _Pose
    resolution: tuple[int, int]
    camera_model: Literal["pinhole"]
    intrinsics: tuple[float, float, float, float]
    distortion_model: Literal["radial-tangential", "radtan", "none"] = "radial-tangential"
    distortion_coefficients: list[float]


def load_calibration(path: Path) -> Rig:
    """Read calib.yaml; raises CalibrationError that names the file and the key.

    Keys: ``model`` (pinhole), ``width height`` (pixels), ``fx fy cx cy`` (pixels), ``distortion`` (0, 4, 5 or 8 numbers
    in OpenCV's order), ``depth_factor`` (raw units per metre), and for stereo ``T_cam0_cam1`` (4x4, maps the right
    camera's frame into the left one's) or ``baseline`` (metres, for a rectified pair). Both cameras then share the
    intrinsics.
    """
    file = _validated(path, _load_yaml(path), _CalibrationFile)
    try:
        cam0 = Camera(file.width, file.height, file.fx, file.fy, file.cx, file.cy, tuple(file.distortion))
        T_cam0_cam1 = _right_eye(file)
        return Rig(cam0, None if T_cam0_cam1 is None else cam0, T_cam0_cam1, file.depth_factor)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def load_euroc_sensor(path: Path) -> tuple[Camera, Matrix]:
    """Read an EuRoC camera's sensor.yaml; returns the camera and T_body_cam (4, 4). Raises CalibrationError."""
    file = _validated(path, _load_yaml(path), _EurocSensor)
    width, height = file.resolution
    try:
        camera = Camera(width, height, *file.intrinsics, tuple(file.distortion_coefficients))
        return camera, _rigid(file.T_BS.data, "T_BS")
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def load_kitti_calibration(path: Path, size: tuple[int, int]) -> Rig:
    """Read KITTI's calib.txt (rows ``P0:`` and, for stereo, ``P1:``) for images of (width, height).

    The pair is rectified, so the baseline is -P1[0, 3] / fx metres. Raises CalibrationError.
    """
    rows = dict(line.split(":", 1) for line in _text(path).splitlines() if ":" in line)
    projections = {}
    for name in ("P0", "P1"):
        if name in rows:
            projections[name] = _projection(path, name, rows[name])
    if "P0" not in projections:
        raise CalibrationError(f"{path} has no row P0")
    P0 = projections["P0"]
    try:
        cam0 = Camera(*size, float(P0[0, 0]), float(P0[1, 1]), float(P0[0, 2]), float(P0[1, 2]))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    if "P1" not in projections:
        return Rig(cam0)
    baseline = (P0[0, 3] - projections["P1"][0, 3]) / P0[0, 0]
    if not 0 < baseline < np.inf:
        raise CalibrationError(f"{path}: P0 and P1 give a baseline of {baseline:g} m; it must be positive")
    return Rig(cam0, cam0, se3.make(np.eye(3), np.array([baseline, 0, 0])))


def _right_eye(file: _CalibrationFile) -> Matrix | None:
    if file.T_cam0_cam1 is None:
        return None if file.baseline is None else se3.make(np.eye(3), np.array([file.baseline, 0, 0]))
    T = _rigid(file.T_cam0_cam1, "T_cam0_cam1")
    length = float(np.linalg.norm(T[:3, 3]))
    if length == 0:
        raise CalibrationError("T_cam0_cam1 has no translation, so the two cameras see no depth")
    if file.baseline is not None and abs(file.baseline - length) > BASELINE_TOLERANCE * length:
        raise CalibrationError(f"baseline is {file.baseline:g} m but T_cam0_cam1 says {length:g} m")
    return T


def _rigid(numbers: list[float], name: str) -> Matrix:
    T = np.array(numbers, np.float64).reshape(4, 4)
    R = T[:3, :3]
    orthogonal = np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE) and np.linalg.det(R) > 0
    if not np.isfinite(T).all() or not orthogonal or not np.array_equal(T[3], [0, 0, 0, 1]):
        raise CalibrationError(f"{name} is not a rigid motion")
    return se3.orthonormalise(T)


def _projection(path: Path, name: str, text: str) -> Matrix:
    try:
        return np.array([float(number) for number in text.split()], np.float64).reshape(3, 4)
    except ValueError as error:
        raise CalibrationError(f"{path}: {name} must have 12 numbers") from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path} cannot be read as a calibration: {error}") from error


def _load_yaml(path: Path) -> dict[str, Any]:
    # OpenCV's writer starts its files with "%YAML:1.0", which is no valid directive.
    lines = [line for line in _text(path).splitlines() if not line.startswith("%YAML:")]
    try:
        content = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} must hold keys and values")
    return content


def _validated(path: Path, content: dict[str, Any], model: type[Model]) -> Model:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {sentence(error, model)}") from error
