"""Rendered sequences on disk in the layout of the TUM RGB-D sets: pictures, lists, ground truth, calibration.

Beside them, where they were asked for, lie labels: which pixels are static, sky, people (renderer.View).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth.sensor import CodedFrame, decode
from seamark.datasets_synth.sequence import GroundTruth
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig
from seamark.frontend.types import Frame, Mode


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"


def names(index: int) -> tuple[str, str, str]:
    """Return the files of a frame, relative to the folder: picture, right picture, depth."""
    return f"rgb/{index:06d}.jpg", f"right/{index:06d}.jpg", f"depth/{index:06d}.png"


def labels_name(index: int) -> str:
    """Return the file of the labels of a frame, relative to the folder."""
    return f"labels/{index:06d}.png"


def start(folder: Path, mode: Mode, *, labels: bool = False) -> None:
    """Make the folder and those inside it for the pictures."""
    for name in _contents(mode, labels):
        (folder / name).mkdir(parents=True, exist_ok=True)


def _contents(mode: Mode, labels: bool) -> list[str]:
    """Return the folders that a frame has a file in."""
    return ["rgb", *({Mode.RGBD: ["depth"], Mode.STEREO: ["right"]}.get(mode, [])), *(["labels"] if labels else [])]


def store(folder: Path, coded: CodedFrame) -> None:
    """Write the files of one frame, each so that it is there completely or not at all."""
    files = zip((*names(coded.index), labels_name(coded.index)), coded.blobs, strict=True)
    for name, blob in files:
        if blob:
            fresh = folder / f"{name}.new"
            fresh.write_bytes(blob)
            fresh.replace(folder / name)


def stored(folder: Path, mode: Mode, *, labels: bool = False) -> int:
    """Return how many frames, from the first on, have all their files."""
    kinds = _contents(mode, labels)
    present = [{file.stem for file in (folder / kind).iterdir() if file.suffix != ".new"} for kind in kinds]
    whole = set.intersection(*present)
    return next(index for index in range(len(whole) + 1) if f"{index:06d}" not in whole)


def read_coded(folder: Path, index: int) -> CodedFrame:
    """Return one frame as it was stored; what is missing is empty."""
    files = [folder / name for name in (*names(index), labels_name(index))]
    return CodedFrame(index, *(file.read_bytes() if file.is_file() else b"" for file in files))


def finish(folder: Path, title: str, mode: Mode, rig: Rig, truth: GroundTruth) -> None:
    """Write the lists, the ground truth (T_world_cam of cam0) and calib.yaml."""
    stamps = [_seconds(int(stamp)) for stamp in truth.stamps_ns]
    files = [names(index) for index in range(len(stamps))]
    columns = {"rgb": 0, **({"depth": 2} if mode is Mode.RGBD else {}), **({"right": 1} if mode is Mode.STEREO else {})}
    for name, column in columns.items():
        lines = [f"# {title}", "# timestamp filename"]
        lines += [f"{stamp} {file[column]}" for stamp, file in zip(stamps, files, strict=True)]
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if mode is Mode.RGBD:
        pairs = [f"{stamp} {file[0]} {stamp} {file[2]}" for stamp, file in zip(stamps, files, strict=True)]
        (folder / "associations.txt").write_text("\n".join(pairs) + "\n", encoding="utf-8")
    lines = [f"# {title}: T_world_cam, exact", "# timestamp tx ty tz qx qy qz qw"]
    for stamp, T in zip(stamps, truth.T_world_cam, strict=True):
        numbers = [*T[:3, 3], *se3.to_quaternion(T[:3, :3])]
        lines.append(" ".join([stamp, *(f"{number:.9f}" for number in numbers)]))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "calib.yaml").write_text(_calibration(rig, mode), encoding="utf-8")


def _calibration(rig: Rig, mode: Mode) -> str:
    camera = rig.cam0
    lines = ["model: pinhole", f"width: {camera.width}", f"height: {camera.height}"]
    lines += [f"{key}: {getattr(camera, key)!r}" for key in ("fx", "fy", "cx", "cy")]
    lines.append(f"distortion: {list(camera.distortion)!r}")
    if mode is Mode.RGBD:
        lines.append(f"depth_factor: {rig.depth_factor!r}")
    if rig.T_cam0_cam1 is not None:
        lines.append(f"baseline: {float(np.linalg.norm(rig.T_cam0_cam1[:3, 3]))!r}")
        lines.append("T_cam0_cam1:")
        lines += [f"  - {row!r}" for row in rig.T_cam0_cam1.tolist()]
    return "\n".join(lines) + "\n"


def read_frames(folder: Path, stamps_ns: NDArray[np.int64]) -> Iterator[Frame]:
    """Yield the frames of a finished folder; raises SeamarkError where a file is missing or cannot be decoded."""
    for index, stamp in enumerate(stamps_ns):
        yield decode(read_coded(folder, index), int(stamp), names(index)[0])


def read_ground_truth(folder: Path) -> GroundTruth:
    """Return the poses in groundtruth.txt; raises SeamarkError where there are none."""
    file = folder / "groundtruth.txt"
    if not file.is_file():
        raise SeamarkError(f"there is no ground truth at {file}")
    rows = [line.split() for line in file.read_text(encoding="utf-8").splitlines() if line and line[0] != "#"]
    stamps = np.array(
        [int(second) * 10**9 + int(rest) for second, rest in (row[0].split(".") for row in rows)], np.int64
    )
    numbers = np.array([row[1:] for row in rows], np.float64)
    poses = [se3.make(R, t) for R, t in zip(se3.from_quaternion(numbers[:, 3:]), numbers[:, :3], strict=True)]
    return GroundTruth(stamps, np.stack(poses))


def read_rig(folder: Path) -> Rig:
    """Return the single camera of calib.yaml as :func:`finish` writes it."""
    lines = (folder / "calib.yaml").read_text(encoding="utf-8").splitlines()
    values = dict(line.split(": ", 1) for line in lines if ": " in line)
    fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
    camera = Camera(int(values["width"]), int(values["height"]), fx, fy, cx, cy)
    return Rig(camera, depth_factor=float(values["depth_factor"]))
