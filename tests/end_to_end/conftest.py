"""Data sets on disk made from the toy world, in the layouts that users have."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend import se3
from seamark.frontend.types import Mode

N_FRAMES = 130


def calibration(world: ToyWorld, extra: str = "") -> str:
    c = world.camera
    size = f"width: {c.width}\nheight: {c.height}\n"
    return f"model: pinhole\n{size}fx: {c.fx}\nfy: {c.fy}\ncx: {c.cx}\ncy: {c.cy}\ndistortion: []\n{extra}"


def seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


@pytest.fixture(scope="session")
def toy_tum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a TUM RGB-D folder: one lap and a bit of the toy room."""
    root = tmp_path_factory.mktemp("data") / "toy_tum"
    world = ToyWorld(3)
    sequence = toy_sequence("loop", N_FRAMES, sensors=Mode.RGBD, world=world)
    for folder in ("rgb", "depth"):
        (root / folder).mkdir(parents=True)
    pairs, truth = [], []
    for frame, T in zip(sequence.frames(), sequence.ground_truth.T_world_cam, strict=True):
        stamp, name = seconds(frame.stamp_ns), f"{frame.index:06d}.png"
        cv2.imwrite(str(root / "rgb" / name), frame.image)
        cv2.imwrite(str(root / "depth" / name), np.rint(frame.depth * 5000).astype(np.uint16))
        pairs.append(f"{stamp} rgb/{name} {stamp} depth/{name}\n")
        pose = (*T[:3, 3], *se3.to_quaternion(T[:3, :3]))
        truth.append(" ".join([stamp, *(f"{v:.9g}" for v in pose)]) + "\n")
    (root / "associations.txt").write_text("".join(pairs))
    (root / "groundtruth.txt").write_text("".join(truth))
    (root / "calib.yaml").write_text(calibration(world, "depth_factor: 5000\n"))
    return root


@pytest.fixture(scope="session")
def toy_kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a KITTI odometry folder: 40 stereo frames along a line."""
    root = tmp_path_factory.mktemp("data") / "toy_kitti"
    world = ToyWorld(3)
    sequence = toy_sequence("line", 40, sensors=Mode.STEREO, world=world)
    for folder in ("image_0", "image_1"):
        (root / folder).mkdir(parents=True)
    poses = []
    for frame, T in zip(sequence.frames(), sequence.ground_truth.T_world_cam, strict=True):
        cv2.imwrite(str(root / "image_0" / f"{frame.index:06d}.png"), cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY))
        right = cv2.cvtColor(frame.image_right, cv2.COLOR_BGR2GRAY)
        cv2.imwrite(str(root / "image_1" / f"{frame.index:06d}.png"), right)
        poses.append(" ".join(f"{v:.9g}" for v in T[:3].ravel()) + "\n")
    c = world.camera
    row = f"{c.fx} 0 {c.cx} {{}} 0 {c.fy} {c.cy} 0 0 0 1 0\n"
    (root / "calib.txt").write_text("P0: " + row.format(0) + "P1: " + row.format(-c.fx * world.baseline_m))
    (root / "poses.txt").write_text("".join(poses))
    return root


@pytest.fixture
def n_frames() -> int:
    """Return how many frames the toy_tum folder holds."""
    return N_FRAMES
