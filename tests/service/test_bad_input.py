"""What hostile files and settings lead to: a sentence, never a traceback."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.errors import MapError
from seamark.backend.map_store import MapStore
from seamark.backend.verify import Rejected, verify
from seamark.frontend.camera import CalibrationError
from seamark.frontend.types import Features, Frame, Keyframe, Mode, Rig
from seamark.service.calibration import load_calibration, load_kitti_calibration
from seamark.service.config import ConfigError, load_config
from seamark.service.output import OutputError, prepare_output
from seamark.service.run import check_size
from seamark.service.sources.base import SourceError
from seamark.service.sources.decode import UnreadableImageError, decode
from seamark.service.sources.open import open_sources
from seamark.service.stamps import parse_stamp
from seamark.service.trajectory_files import TrajectoryError, load_kitti, load_tum

CALIBRATION = "model: pinhole\nwidth: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 32\ncy: 24\n"


@pytest.mark.parametrize("text", ["1e30", "-1e30", "9223372036"])
def test_stamps_beyond_64_bits(text: str) -> None:
    """Test: stamps in seconds whose nanoseconds do not fit. Expected: ValueError that names the stamp."""
    with pytest.raises(ValueError, match=text):
        parse_stamp(text)


@pytest.mark.parametrize("fps", [0.0, -1.0, 1e-300, 1e12, float("nan"), float("inf")])
def test_frame_rates_without_meaning(tmp_path: Path, fps: float) -> None:
    """Test: frame rates whose stamps overflow or repeat. Expected: SourceError that tells the possible ones."""
    with pytest.raises(SourceError, match="must be within"):
        open_sources([str(tmp_path)], fps=fps)


@pytest.mark.parametrize("row", ["nan " * 12, "0 " * 12, "1e300 " * 12, "1 2"])
def test_poses_that_are_none(tmp_path: Path, row: str) -> None:
    """Test: KITTI rows that are no rigid motion. Expected: TrajectoryError that names the line."""
    path = tmp_path / "poses.txt"
    path.write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{row}\n")
    with pytest.raises(TrajectoryError, match="line 2"):
        load_kitti(path)


def test_positions_that_are_none(tmp_path: Path) -> None:
    """Test: TUM rows, one of them 1e308 m away. Expected: it is left out, as one with NaN is."""
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2 1e308 0 0 0 0 0 1\n3 nan 0 0 0 0 0 1\n")
    assert load_tum(path).stamps_ns.tolist() == [10**9]


@pytest.mark.parametrize("key", ["fx: .inf", "cx: .nan", "depth_factor: .inf", "baseline: .inf"])
def test_calibration_with_infinite_numbers(tmp_path: Path, key: str) -> None:
    """Test: a calibration with one number that is none. Expected: CalibrationError that names file and key."""
    path = tmp_path / "calib.yaml"
    name = key.split(":")[0]
    path.write_text(
        "".join(f"{line}\n" for line in [*CALIBRATION.splitlines(), key] if line == key or name not in line)
    )
    with pytest.raises(CalibrationError, match=rf"calib\.yaml: {name} = "):
        load_calibration(path)


def test_kitti_calibration_of_zeros(tmp_path: Path) -> None:
    """Test: a calib.txt of zeros. Expected: CalibrationError that names the file."""
    path = tmp_path / "calib.txt"
    path.write_text("P0: " + "0 " * 12)
    with pytest.raises(CalibrationError, match=r"calib\.txt: "):
        load_kitti_calibration(path, (64, 48))


def test_unknown_sections_name_their_origin(tmp_path: Path) -> None:
    """Test: an unknown section from a file, the environment, -o; a section that is a number.

    Expected: ConfigError with origin and path, even where -o sets a key of that section.
    """
    path = tmp_path / "c.yaml"
    path.write_text("nope: {a: 1}\n")
    with pytest.raises(ConfigError, match=r"c\.yaml: nope is not a known key"):
        load_config(path)
    with pytest.raises(ConfigError, match="SEAMARK_NOPE__A: nope is not a known key"):
        load_config(None, {"SEAMARK_NOPE__A": "1"})
    with pytest.raises(ConfigError, match="-o: nope is not a known key"):
        load_config(None, {}, ["nope.a=1"])
    path.write_text("vocab: 3\n")
    with pytest.raises(ConfigError, match=r"c\.yaml: vocab = 3"):
        load_config(path, {}, ["vocab.candidates=5"])


def test_results_that_a_folder_obstructs(tmp_path: Path) -> None:
    """Test: the last of three results has the name of a folder. Expected: OutputError, the other two stay as before."""
    (tmp_path / "a").write_text("before")
    (tmp_path / "c").mkdir()
    with pytest.raises(OutputError, match="is a folder"), prepare_output(tmp_path) as output:
        for name in "abc":
            (output.staging / name).write_text("new")
        output.commit()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
    assert (tmp_path / "a").read_text() == "before"


class _OneSource:
    """As much of a source as the check of sizes reads."""

    name, mode = "walk", Mode.RGBD

    def __init__(self, rig: Rig) -> None:
        self.rig = rig


@pytest.mark.parametrize(("what", "field"), [("depth image", "depth"), ("right image", "image_right")])
def test_second_picture_of_another_size(tmp_path: Path, what: str, field: str) -> None:
    """Test: the first frame's depth or right image has half the size. Expected: SourceError that says so."""
    path = tmp_path / "calib.yaml"
    path.write_text(CALIBRATION)
    half = np.zeros((24, 32), np.uint16 if field == "depth" else np.uint8)
    frame = Frame(0, 0, np.zeros((48, 64), np.uint8), file="0.png", **{field: half})
    with pytest.raises(SourceError, match=rf"the {what} of 0\.png has 32 x 24 pixels"):
        check_size(frame, _OneSource(load_calibration(path)))  # type: ignore[arg-type]


def test_small_file_that_claims_a_huge_image() -> None:
    """Test: a PNG whose header alone says 20000 x 20000. Expected: UnreadableImageError that says so."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 20000, 20000, 8, 0, 0, 0, 0)
    chunks = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    with pytest.raises(UnreadableImageError, match="20000 x 20000 pixels"):
        decode(b"\x89PNG\r\n\x1a\n" + chunks, "the query image")


def test_a_map_has_one_writer(tmp_path: Path) -> None:
    """Test: a map is opened twice for writing. Expected: MapError, reading goes on, and after closing it is free."""
    path = tmp_path / "map.seamark"
    with MapStore(path):
        with pytest.raises(MapError, match="in use by another process"):
            MapStore(path)
        MapStore(path, read_only=True).close()
    MapStore(path).close()


def test_geometry_when_opencv_asserts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Test: OpenCV's estimator asserts, as 5.0 does for almost equal images. Expected: a verdict all the same."""
    rng = np.random.default_rng(1)
    points = rng.uniform(10, 300, (60, 2)).astype(np.float32)
    features = Features(
        points, np.ones(60, np.float32), np.zeros(60, np.float32), rng.integers(0, 255, (60, 128)).astype(np.uint8)
    )
    landmarks, thumbnail = np.full((60, 3), np.nan, np.float32), np.zeros((8, 8), np.uint8)
    one, other = (
        Keyframe(i, 0, i, i, "", features=features, landmarks=landmarks, thumbnail=thumbnail, jpeg=b"") for i in (0, 1)
    )
    honest = cv2.findFundamentalMat

    def asserting(first: object, second: object, *settings: object) -> object:
        if isinstance(settings[0], cv2.UsacParams):
            raise cv2.error("model.empty()")
        return honest(first, second, *settings)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "findFundamentalMat", asserting)
    verdict = verify(one, other, VerificationConfig.model_validate({}), 0)
    assert not isinstance(verdict, Rejected)
    assert 54 <= verdict.inliers <= 60
