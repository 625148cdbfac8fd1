"""EuRoC folders in ASL form: mav0/cam0, cam1, state_groundtruth_estimate0 (Burri et al. 2016)."""

import logging
from pathlib import Path

import numpy as np

from seamark.frontend import se3
from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode
from seamark.service.calibration import Matrix, load_euroc_sensor
from seamark.service.evaluation import associate
from seamark.service.sources.base import Entry, FileSource, SourceError, choose, file_source, offered
from seamark.service.sources.images import list_images
from seamark.service.stamps import MAX_STAMP_NS
from seamark.service.trajectory_files import load_euroc
from seamark.service.types import Trajectory

MAX_DIFFERENCE_S = 0.005
TRUTH = Path("state_groundtruth_estimate0") / "data.csv"

logger = logging.getLogger(__name__)


def is_euroc(folder: Path) -> bool:
    """Tell whether a folder, or mav0 in it, looks like an EuRoC sequence."""
    return any((root / "cam0" / "data").is_dir() for root in (folder, folder / "mav0"))


def open_euroc(folder: Path, *, rig: Rig | None, mode: Mode | None) -> FileSource:
    """Open an EuRoC sequence; ``rig`` overrides its sensor.yaml files. Raises SourceError.

    In stereo the images pair by equal stamps, else by the nearest within 5 ms, one to one; left images without a right
    one are then left out. Ground truth is of the body and is moved to cam0 by T_BS of cam0/sensor.yaml.
    """
    root = folder if (folder / "cam0" / "data").is_dir() else folder / "mav0"
    own, T_body_cam0 = _calibration(root)
    rig = rig or own
    left = _listed(root / "cam0")
    right = _listed(root / "cam1") if (root / "cam1" / "data").is_dir() else []
    modes = offered(rig, stereo=bool(right), depth=False)
    if choose(mode, modes, str(folder)) is Mode.STEREO:
        entries = _paired(folder, left, right)
    else:
        entries = [Entry(stamp, path) for stamp, path in left]
    return file_source(folder, entries, rig, _ground_truth(root, T_body_cam0), modes, mode)


def _calibration(root: Path) -> tuple[Rig | None, Matrix | None]:
    if not (root / "cam0" / "sensor.yaml").is_file():
        return None, None
    cam0, T_body_cam0 = load_euroc_sensor(root / "cam0" / "sensor.yaml")
    if not (root / "cam1" / "sensor.yaml").is_file():
        return Rig(cam0), T_body_cam0
    cam1, T_body_cam1 = load_euroc_sensor(root / "cam1" / "sensor.yaml")
    return Rig(cam0, cam1, se3.inverse(T_body_cam0) @ T_body_cam1), T_body_cam0


def _paired(folder: Path, left: list[tuple[int, Path]], right: list[tuple[int, Path]]) -> list[Entry]:
    i, j = associate(
        np.array([stamp for stamp, _ in left], np.int64),
        np.array([stamp for stamp, _ in right], np.int64),
        MAX_DIFFERENCE_S,
    )
    if len(i) == 0:
        raise SourceError(f"{folder}: no image of cam0 has one of cam1 within {MAX_DIFFERENCE_S} s")
    if len(i) < len(left):
        logger.warning("%s: %d of %d images of cam0 have no partner in cam1", folder, len(left) - len(i), len(left))
    return [Entry(left[a][0], left[a][1], right=right[b][1]) for a, b in zip(i, j, strict=True)]


def _listed(camera: Path) -> list[tuple[int, Path]]:
    """Return (stamp, file) in the order of data.csv, or of the names (nanoseconds) where there is no such file."""
    path = camera / "data.csv"
    if path.is_file():
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [[field.strip() for field in line.split(",")] for line in lines if line.strip() and line[0] != "#"]
    else:
        rows = [[image.stem, image.name] for image in list_images(camera / "data")]
    out = []
    for row in rows:
        if len(row) < 2 or not row[0].isdecimal() or int(row[0]) > MAX_STAMP_NS:
            raise SourceError(f"{camera}: {','.join(row)!r} is not 'nanoseconds,file'")
        out.append((int(row[0]), camera / "data" / row[1]))
    if not out:
        raise SourceError(f"{camera} names no images")
    return out


def _ground_truth(root: Path, T_body_cam0: Matrix | None) -> Trajectory | None:
    if T_body_cam0 is None or not (root / TRUTH).is_file():
        return None
    body = load_euroc(root / TRUTH)
    return Trajectory(body.stamps_ns, body.T_world_cam @ T_body_cam0)
