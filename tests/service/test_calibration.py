from pathlib import Path

import numpy as np
import pytest

from seamark.frontend.camera import CalibrationError
from seamark.service.calibration import load_calibration, load_euroc_sensor, load_kitti_calibration

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL DATA NOT TESTED: {DATA} is missing")

GOOD = (
    "model: pinhole\nwidth: 640\nheight: 480\nfx: 500\nfy: 501\ncx: 320\ncy: 240\ndistortion: [0.1, -0.2, 0, 1e-3, 0]\n"
)


def write(folder: Path, text: str) -> Path:
    path = folder / "calib.yaml"
    path.write_text(text)
    return path


def test_reads_every_key(tmp_path: Path) -> None:
    rig = load_calibration(write(tmp_path, GOOD + "depth_factor: 5000\nbaseline: 0.12\n"))
    assert (rig.cam0.width, rig.cam0.height) == (640, 480)
    assert (rig.cam0.fx, rig.cam0.fy, rig.cam0.cx, rig.cam0.cy) == (500, 501, 320, 240)
    assert rig.cam0.distortion == (0.1, -0.2, 0, 1e-3, 0)
    assert rig.depth_factor == 5000
    assert rig.cam1 == rig.cam0
    assert rig.T_cam0_cam1 is not None
    assert rig.T_cam0_cam1[:3, 3].tolist() == [0.12, 0, 0]


def test_defaults(tmp_path: Path) -> None:
    rig = load_calibration(write(tmp_path, GOOD.split("distortion")[0]))
    assert rig.cam0.distortion == ()
    assert rig.depth_factor == 1000
    assert rig.cam1 is None


@pytest.mark.parametrize(
    "matrix",
    [
        "[[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0], [0, 0, 0, 1]]",
        "[0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0, 0, 0, 0, 1]",
    ],
)
def test_right_camera_nested_or_flat(tmp_path: Path, matrix: str) -> None:
    rig = load_calibration(write(tmp_path, GOOD + f"T_cam0_cam1: {matrix}\n"))
    assert rig.T_cam0_cam1 is not None
    np.testing.assert_allclose(rig.T_cam0_cam1[:3], [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD + "depthfactor: 1\n", r"calib\.yaml: depthfactor is not a known key; did you mean depth_factor"),
        (GOOD.replace("pinhole", "fisheye"), "model = 'fisheye'"),
        (GOOD.replace("fx: 500\n", ""), "fx is missing"),
        (GOOD.replace("fx: 500", "fx: wide"), "fx = 'wide'"),
        (GOOD.replace("fx: 500", "fx: -1"), "fx = -1"),
        (GOOD.replace("fx: 500", "fx: .nan"), "fx = nan"),
        (GOOD.replace("[0.1, -0.2, 0, 1e-3, 0]", "[1, 2]"), "distortion has 2 numbers"),
        (GOOD + "T_cam0_cam1: [1, 2]\n", "T_cam0_cam1"),
        (GOOD + "T_cam0_cam1: [1,0,0,1, 0,2,0,0, 0,0,1,0, 0,0,0,1]\n", "rigid"),
        (GOOD + "T_cam0_cam1: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n", "no translation"),
        (GOOD + "baseline: 0.2\nT_cam0_cam1: [1,0,0,1, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n", "baseline is 0.2 m"),
        ("just words", "keys and values"),
        ("a: [1", "not valid YAML"),
    ],
)
def test_bad_files_are_named_with_their_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        load_calibration(write(tmp_path, text))
    assert "calib.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nothing\.yaml"):
        load_calibration(tmp_path / "nothing.yaml")


def test_kitti_baseline_from_p1(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text("P0: 700 0 600 0 0 701 180 0 0 0 1 0\nP1: 700 0 600 -350 0 701 180 0 0 0 1 0\nTr: 1 2\n")
    rig = load_kitti_calibration(path, (1226, 370))
    assert (rig.cam0.width, rig.cam0.height, rig.cam0.fx, rig.cam0.fy, rig.cam0.cy) == (1226, 370, 700, 701, 180)
    assert rig.T_cam0_cam1 is not None
    assert rig.T_cam0_cam1[0, 3] == 0.5
    path.write_text("P1: 700 0 600 -350 0 700 180 0 0 0 1 0\n")
    with pytest.raises(CalibrationError, match="no row P0"):
        load_kitti_calibration(path, (1226, 370))
    path.write_text("P0: 700 0 600\n")
    with pytest.raises(CalibrationError, match="12 numbers"):
        load_kitti_calibration(path, (1226, 370))


@pytest.mark.real_data
@needs_data
def test_euroc_sensor() -> None:
    camera, T_body_cam = load_euroc_sensor(DATA / "euroc_v101_stereo_keyframes" / "mav0" / "cam0" / "sensor.yaml")
    assert (camera.width, camera.height, camera.fx, camera.cy) == (752, 480, 458.654, 248.375)
    assert camera.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    np.testing.assert_allclose(T_body_cam[:3, 3], [-0.0216401454975, -0.064676986768, 0.00981073058949], atol=1e-12)
