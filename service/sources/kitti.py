"""KITTI odometry folders: image_0, image_1, calib.txt, times.txt, poses.txt (Geiger et al. 2012)."""

from pathlib import Path

from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode
from seamark.service.calibration import load_kitti_calibration
from seamark.service.sources.base import Entry, FileSource, SourceError, choose, file_source, offered
from seamark.service.sources.decode import UnreadableImageError, read_image
from seamark.service.sources.images import list_images
from seamark.service.stamps import running_stamp
from seamark.service.trajectory_files import load_kitti, load_times
from seamark.service.types import Trajectory

DEFAULT_RATE_HZ = 10.0


def is_kitti(folder: Path) -> bool:
    """Tell whether a folder looks like a KITTI odometry sequence."""
    return (folder / "image_0").is_dir()


def open_kitti(folder: Path, *, rig: Rig | None, mode: Mode | None) -> FileSource:
    """Open a KITTI odometry sequence; ``rig`` overrides its calib.txt. Raises SourceError."""
    left = list_images(folder / "image_0")
    if not left:
        raise SourceError(f"{folder / 'image_0'} holds no images")
    right = list_images(folder / "image_1") if (folder / "image_1").is_dir() else []
    right_of = {path.stem: path for path in right}
    if rig is None and (folder / "calib.txt").is_file():
        rig = load_kitti_calibration(folder / "calib.txt", _size(left))
    modes = offered(rig, stereo=bool(right), depth=False)
    if choose(mode, modes, str(folder)) is Mode.STEREO and len(left) != len(right):
        raise SourceError(
            f"{folder}: image_0 has {len(left)} images but image_1 has {len(right)}; each needs its partner"
        )
    rights = [right_of.get(path.stem) for path in left]
    stamps = _stamps(folder, len(left))
    entries = [Entry(stamp, a, right=b) for stamp, a, b in zip(stamps, left, rights, strict=True)]
    return file_source(folder, entries, rig, _ground_truth(folder, len(left)), modes, mode)


def _stamps(folder: Path, count: int) -> list[int]:
    path = folder / "times.txt"
    if not path.is_file():
        return [running_stamp(k, DEFAULT_RATE_HZ) for k in range(count)]
    stamps: list[int] = load_times(path).tolist()
    if len(stamps) != count:
        raise SourceError(f"{path} has {len(stamps)} times for {count} images in image_0")
    return stamps


def _ground_truth(folder: Path, count: int) -> Trajectory | None:
    path = folder / "poses.txt"
    if not path.is_file():
        return None
    times = folder / "times.txt"
    # Equal numbers of poses and times are checked there; repeated times leave fewer poses than rows.
    truth = load_kitti(path, times if times.is_file() else None, DEFAULT_RATE_HZ)
    if len(truth) != count and not times.is_file():
        raise SourceError(f"{path} has {len(truth)} poses for {count} images in image_0")
    return truth


def _size(files: list[Path]) -> tuple[int, int]:
    """Return (width, height) of the first image that can be read."""
    for path in files:
        try:
            height, width = read_image(path).shape[:2]
        except UnreadableImageError:
            continue
        return width, height
    raise SourceError(f"no image of {files[0].parent} can be read")
