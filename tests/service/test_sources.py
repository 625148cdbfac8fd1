from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth.sequence import GroundTruth, SynthSequence
from seamark.frontend.camera import CalibrationError, Camera, Rig
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.base import Source, SourceError, Unreadable
from seamark.service.sources.decode import UnreadableImageError, jpeg_complete, read_depth, read_image
from seamark.service.sources.images import natural_key
from seamark.service.sources.open import open_sources

CALIB = "model: pinhole\nwidth: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 16\ncy: 12\ndistortion: []\ndepth_factor: 5000\n"


def picture(value: int = 0, *, colour: bool = False) -> np.ndarray:
    ramp = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8) * 4
    grey = np.roll(ramp, value, axis=1)
    return np.dstack([grey, grey // 2, 255 - grey]) if colour else grey


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def truncate(path: Path, share: float = 0.6) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def frames(source: Source) -> list[Frame | Unreadable]:
    return list(source.frames())


def make_tum(folder: Path, *, associations: bool = False, calib: bool = True, offset: float = 0.004) -> Path:
    colour, depth, both, truth = [], [], [], []
    for k in range(4):
        write(folder / f"rgb/{k}.png", picture(k, colour=True))
        write(folder / f"depth/{k}.png", np.full((24, 32), 5000 + k, np.uint16))
        a, b = f"{k * 0.1 + 1:.6f} rgb/{k}.png", f"{k * 0.1 + 1 + offset:.6f} depth/{k}.png"
        colour.append(a)
        depth.append(b)
        both.append(f"{a} {b}")
        truth.append(f"{k * 0.1 + 1.001:.4f} {k} 0 0 0 0 0 1")
    (folder / "rgb.txt").write_text("# colour\n" + "\n".join(colour) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    if associations:
        (folder / "associations.txt").write_text("\n".join(both[:3]) + "\n")
    if calib:
        (folder / "calib.yaml").write_text(CALIB)
    return folder


def make_euroc(folder: Path, *, late_ns: int = 0) -> Path:
    rotated = "[0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]"
    right = "[0, -1, 0, 0.1, 1, 0, 0, 0.31, 0, 0, 1, 0.3, 0, 0, 0, 1]"
    for camera, pose in (("cam0", rotated), ("cam1", right)):
        rows = ["#timestamp [ns],filename"]
        for k in range(3):
            stamp = 1_403_715_273_262_142_976 + k * 50_000_000 + (late_ns if camera == "cam1" else 0)
            write(folder / "mav0" / camera / "data" / f"{stamp}.png", picture(k))
            rows.append(f"{stamp},{stamp}.png\r")
        (folder / "mav0" / camera / "data.csv").write_text("\n".join(rows) + "\n")
        (folder / "mav0" / camera / "sensor.yaml").write_text(
            f"%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {pose}\nresolution: [32, 24]\n"
            "camera_model: pinhole\nintrinsics: [30, 30, 16, 12]\ndistortion_model: radial-tangential\n"
            "distortion_coefficients: [0, 0, 0, 1e-05]\n"
        )
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    (truth / "data.csv").write_text("#t,p,q\n1403715273262142976,1,2,3,0,0,0,1" + ",0" * 9 + "\n")
    return folder


def make_kitti(folder: Path, *, times: bool = True, right: int = 3) -> Path:
    for k in range(3):
        write(folder / "image_0" / f"{k:06d}.png", picture(k))
    for k in range(right):
        write(folder / "image_1" / f"{k:06d}.png", picture(k + 1))
    (folder / "calib.txt").write_text("P0: 30 0 16 0 0 30 12 0 0 0 1 0\nP1: 30 0 16 -15 0 30 12 0 0 0 1 0\n")
    (folder / "poses.txt").write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3)))
    if times:
        (folder / "times.txt").write_text("0.0\n1.037359e-01\n2.0e-1\n")
    return folder


def make_images(folder: Path, names: list[str]) -> Path:
    for k, name in enumerate(names):
        write(folder / name, picture(k, colour=True))
    return folder


class TestTum:
    def test_nearest_depth_and_ground_truth(self, tmp_path: Path) -> None:
        source = open_sources([str(make_tum(tmp_path / "walk"))])
        assert (source.name, source.mode, source.n_frames) == ("walk", Mode.RGBD, 4)
        assert source.modes == (Mode.RGBD, Mode.MONO, Mode.PLACES)
        assert source.ground_truth is not None
        assert source.ground_truth.T_world_cam[:, 0, 3].tolist() == [0, 1, 2, 3]
        got = frames(source)
        assert [f.stamp_ns for f in got] == [1_000_000_000, 1_100_000_000, 1_200_000_000, 1_300_000_000]
        frame = got[2]
        assert isinstance(frame, Frame)
        assert frame.file == "rgb/2.png"
        np.testing.assert_array_equal(frame.image, picture(2, colour=True))
        assert frame.depth is not None
        assert frame.depth.dtype == np.uint16
        assert int(frame.depth[0, 0]) == 5002

    def test_associations_win(self, tmp_path: Path) -> None:
        assert open_sources([str(make_tum(tmp_path, associations=True, offset=0.5))]).n_frames == 3

    def test_depth_too_far_in_time(self, tmp_path: Path) -> None:
        folder = make_tum(tmp_path, offset=0.03)
        with pytest.raises(SourceError, match=r"within 0\.02 s"):
            open_sources([str(folder)])

    def test_some_without_depth_are_left_out(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        folder = make_tum(tmp_path)
        lines = (folder / "depth.txt").read_text().splitlines()
        (folder / "depth.txt").write_text("\n".join(lines[1:]) + "\n")
        assert open_sources([str(folder)]).n_frames == 3
        assert "1 of 4" in caplog.text

    def test_other_modes(self, tmp_path: Path) -> None:
        folder = make_tum(tmp_path)
        for mode in (Mode.MONO, Mode.PLACES):
            frame = frames(open_sources([str(folder)], mode=mode))[0]
            assert isinstance(frame, Frame)
            assert frame.depth is None
        with pytest.raises(SourceError, match="does not offer mode stereo; it offers rgbd, mono, places"):
            open_sources([str(folder)], mode="stereo")

    def test_without_calibration_only_places(self, tmp_path: Path) -> None:
        folder = make_tum(tmp_path, calib=False)
        assert open_sources([str(folder)]).mode is Mode.PLACES
        with pytest.raises(SourceError, match="--calib"):
            open_sources([str(folder)], mode=Mode.RGBD)
        other = tmp_path / "other.yaml"
        other.write_text(CALIB.replace("5000", "1000"))
        source = open_sources([str(folder)], calib=other)
        assert source.mode is Mode.RGBD
        assert source.rig is not None
        assert source.rig.depth_factor == 1000

    def test_bad_calibration_is_not_passed_over(self, tmp_path: Path) -> None:
        folder = make_tum(tmp_path)
        (folder / "calib.yaml").write_text(CALIB + "heigth: 3\n")
        with pytest.raises(CalibrationError, match="heigth"):
            open_sources([str(folder)])

    @pytest.mark.parametrize(("text", "message"), [("", "names no images"), ("x rgb/0.png\n", "line 1")])
    def test_bad_lists(self, tmp_path: Path, text: str, message: str) -> None:
        folder = make_tum(tmp_path)
        (folder / "rgb.txt").write_text(text)
        with pytest.raises(SourceError, match=message):
            open_sources([str(folder)])

    def test_repeated_and_unordered_stamps_are_passed_on(self, tmp_path: Path) -> None:
        folder = make_tum(tmp_path, associations=True)
        lines = (folder / "associations.txt").read_text().splitlines()
        (folder / "associations.txt").write_text("\n".join([lines[1], lines[1], lines[0]]) + "\n")
        assert [f.stamp_ns for f in frames(open_sources([str(folder)]))] == [
            1_100_000_000,
            1_100_000_000,
            1_000_000_000,
        ]


class TestEuroc:
    @pytest.mark.parametrize("late_ns", [0, 4_000_000])
    def test_stereo_with_ground_truth_of_the_camera(self, tmp_path: Path, late_ns: int) -> None:
        folder = make_euroc(tmp_path / "v1", late_ns=late_ns)
        source = open_sources([str(folder)])
        assert (source.mode, source.modes) == (Mode.STEREO, (Mode.STEREO, Mode.MONO, Mode.PLACES))
        assert source.rig is not None
        assert source.rig.T_cam0_cam1 is not None
        # Both cameras are turned by 90 degrees about z: 0.11 m along the body's y is 0.11 m along their x.
        np.testing.assert_allclose(source.rig.T_cam0_cam1[:3, 3], [0.11, 0, 0], atol=1e-12)
        assert source.rig.cam0.distortion == (0, 0, 0, 1e-5)
        assert source.ground_truth is not None
        # The body is turned by 180 degrees about z at (1, 2, 3).
        np.testing.assert_allclose(source.ground_truth.T_world_cam[0, :3, 3], [1 - 0.1, 2 - 0.2, 3 + 0.3])
        np.testing.assert_allclose(source.ground_truth.T_world_cam[0, :3, 0], [0, -1, 0], atol=1e-12)
        got = frames(source)
        assert [f.stamp_ns - got[0].stamp_ns for f in got] == [0, 50_000_000, 100_000_000]
        assert isinstance(got[1], Frame)
        assert got[1].file == "mav0/cam0/data/1403715273312142976.png"
        assert got[1].image_right is not None
        np.testing.assert_array_equal(got[1].image_right, picture(1))

    def test_the_folder_mav0_itself(self, tmp_path: Path) -> None:
        assert open_sources([str(make_euroc(tmp_path) / "mav0")]).n_frames == 3

    def test_right_images_too_late(self, tmp_path: Path) -> None:
        folder = make_euroc(tmp_path, late_ns=6_000_000)
        with pytest.raises(SourceError, match="cam1"):
            open_sources([str(folder)])
        mono = open_sources([str(folder)], mode="mono")
        frame = frames(mono)[0]
        assert isinstance(frame, Frame)
        assert frame.image_right is None
        assert Mode.STEREO in mono.modes


class TestKitti:
    def test_stereo(self, tmp_path: Path) -> None:
        source = open_sources([str(make_kitti(tmp_path))])
        assert (source.mode, source.n_frames) == (Mode.STEREO, 3)
        assert source.rig is not None
        assert source.rig.T_cam0_cam1 is not None
        assert source.rig.T_cam0_cam1[0, 3] == 0.5
        assert (source.rig.cam0.width, source.rig.cam0.height) == (32, 24)
        assert [f.stamp_ns for f in frames(source)] == [0, 103_735_900, 200_000_000]
        assert source.ground_truth is not None
        assert source.ground_truth.T_world_cam[:, 0, 3].tolist() == [0, 1, 2]

    def test_ten_hertz_without_times(self, tmp_path: Path) -> None:
        source = open_sources([str(make_kitti(tmp_path, times=False))])
        assert [f.stamp_ns for f in frames(source)] == [0, 100_000_000, 200_000_000]

    def test_unequal_counts(self, tmp_path: Path) -> None:
        folder = make_kitti(tmp_path, right=2)
        with pytest.raises(SourceError, match="image_0 has 3 images but image_1 has 2"):
            open_sources([str(folder)])
        assert open_sources([str(folder)], mode="mono").n_frames == 3
        (folder / "times.txt").write_text("0\n1\n")
        with pytest.raises(SeamarkError, match="2 times for 3 images"):
            open_sources([str(folder)], mode="mono")


class TestImages:
    def test_natural_order_and_running_stamps(self, tmp_path: Path) -> None:
        folder = make_images(tmp_path / "walk", ["a10.png", "a9.png", "a1.jpg"])
        (folder / "notes.txt").write_text("no image")
        source = open_sources([str(folder)])
        assert (source.mode, source.modes, source.rig) == (Mode.PLACES, (Mode.PLACES,), None)
        got = frames(source)
        assert [f.file for f in got] == ["a1.jpg", "a9.png", "a10.png"]
        assert [f.stamp_ns for f in got] == [0, 10**9, 2 * 10**9]
        assert [f.stamp_ns for f in frames(open_sources([str(folder)], fps=30))] == [0, 33_333_333, 66_666_667]

    def test_with_calibration_mono(self, tmp_path: Path) -> None:
        folder = make_images(tmp_path, ["1.png"])
        (folder / "calib.yaml").write_text(CALIB)
        assert open_sources([str(folder)]).mode is Mode.MONO

    def test_broken_files_become_unreadable_and_keep_their_place(self, tmp_path: Path) -> None:
        names = [f"{k}.{kind}" for k, kind in enumerate(["jpg", "png", "jpg", "png", "jpg", "png", "tiff"])]
        folder = make_images(tmp_path, names)
        truncate(folder / "0.jpg")
        truncate(folder / "1.png")
        (folder / "2.jpg").write_bytes(b"")
        (folder / "3.png").write_bytes(b"not an image")
        data = bytearray((folder / "5.png").read_bytes())
        data[len(data) // 2] ^= 0xFF
        (folder / "5.png").write_bytes(data)
        got = frames(open_sources([str(folder)]))
        assert [type(f) for f in got] == [Unreadable] * 4 + [Frame, Unreadable, Frame]
        reasons = [f.reason for f in got if isinstance(f, Unreadable)]
        for reason, word in zip(reasons, ["truncated", "truncated", "empty", "decoded", "damaged"], strict=True):
            assert word in reason
        assert [f.index for f in got] == list(range(7))
        assert [f.stamp_ns for f in got] == [k * 10**9 for k in range(7)]

    def test_two_folders_run_on(self, tmp_path: Path) -> None:
        left = make_images(tmp_path / "day_left", ["0.png", "1.png", "2.png"])
        right = make_images(tmp_path / "day_right", ["0.png", "1.png"])
        source = open_sources([str(left), str(right)], fps=30)
        assert source.n_frames == 5
        got = frames(source)
        assert [f.file for f in got][2:4] == ["day_left/2.png", "day_right/0.png"]
        assert [f.index for f in got] == list(range(5))
        assert [f.stamp_ns for f in got] == [round(k * 1e9 / 30) for k in range(5)]
        assert source.stamps_ns is not None
        assert source.stamps_ns.tolist() == [f.stamp_ns for f in got]

    def test_the_same_folder_twice_keeps_names_unique(self, tmp_path: Path) -> None:
        folder = make_images(tmp_path / "walk", ["0.png"])
        got = frames(open_sources([str(folder), str(folder)]))
        assert [f.file for f in got] == ["0_walk/0.png", "1_walk/0.png"]

    def test_reading_twice_gives_the_same(self, tmp_path: Path) -> None:
        source = open_sources([str(make_images(tmp_path, [f"{k}.png" for k in range(9)]))])
        for a, b in zip(frames(source), frames(source), strict=True):
            assert isinstance(a, Frame)
            assert isinstance(b, Frame)
            np.testing.assert_array_equal(a.image, b.image)

    def test_stopping_early_leaves_no_thread_behind(self, tmp_path: Path) -> None:
        source = open_sources([str(make_images(tmp_path, [f"{k}.png" for k in range(20)]))])
        iterator = source.frames()
        next(iterator)
        iterator.close()  # type: ignore[attr-defined]


class TestChain:
    def test_shifted_only_when_needed(self, tmp_path: Path) -> None:
        a, b = make_tum(tmp_path / "a"), make_tum(tmp_path / "b")
        source = open_sources([str(a), str(b)])
        stamps = [f.stamp_ns for f in frames(source)]
        assert stamps[:4] == [1_000_000_000, 1_100_000_000, 1_200_000_000, 1_300_000_000]
        assert stamps[4:] == [1_400_000_000, 1_500_000_000, 1_600_000_000, 1_700_000_000]
        assert source.ground_truth is not None
        assert source.ground_truth.stamps_ns.tolist() == [s + 1_000_000 for s in stamps]
        text = (b / "rgb.txt").read_text().replace("1.", "7.", 1)
        for name in ("rgb.txt", "depth.txt"):
            lines = [line for line in (b / name).read_text().splitlines() if not line.startswith("#")]
            (b / name).write_text("\n".join("9" + line[1:] for line in lines) + "\n")
        assert text
        later = [f.stamp_ns for f in frames(open_sources([str(a), str(b)]))]
        assert later[4] == 9_000_000_000

    def test_common_mode(self, tmp_path: Path) -> None:
        a, b = make_tum(tmp_path / "a"), make_images(tmp_path / "b", ["0.png"])
        (b / "calib.yaml").write_text(CALIB)
        source = open_sources([str(a), str(b)])
        assert source.mode is Mode.MONO
        assert source.ground_truth is None

    def test_different_calibrations(self, tmp_path: Path) -> None:
        a, b = make_tum(tmp_path / "a"), make_tum(tmp_path / "b")
        (b / "calib.yaml").write_text(CALIB.replace("fx: 30", "fx: 31"))
        with pytest.raises(SourceError, match="different calibrations"):
            open_sources([str(a), str(b)])
        assert open_sources([str(a), str(b)], mode="places").rig is None


class TestVideo:
    def test_frames_and_rate(self, tmp_path: Path) -> None:
        path = tmp_path / "walk.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20.0, (32, 24))
        for k in range(5):
            writer.write(picture(k, colour=True))
        writer.release()
        source = open_sources([str(path)])
        assert source.mode is Mode.PLACES
        for _ in range(2):
            got = frames(source)
            assert [f.stamp_ns for f in got] == [k * 50_000_000 for k in range(5)]
        assert isinstance(got[3], Frame)
        assert np.abs(got[3].image.astype(int) - picture(3, colour=True)).mean() < 3
        assert frames(open_sources([str(path)], fps=10))[1].stamp_ns == 100_000_000
        both = frames(open_sources([str(path), str(path)]))
        assert [f.stamp_ns for f in both] == [k * 50_000_000 for k in range(10)]

    def test_not_a_video(self, tmp_path: Path) -> None:
        (tmp_path / "x.mp4").write_bytes(b"nothing")
        with pytest.raises(SourceError, match="cannot be read as a video"):
            open_sources([str(tmp_path / "x.mp4")])


class TestWorlds:
    def sequence(self, mode: Mode, closed: list[bool]) -> SynthSequence:
        def make() -> Iterator[Frame]:
            try:
                for k in range(4):
                    right = picture(k) if mode is Mode.STEREO else None
                    depth = np.ones((24, 32), np.uint16) if mode is Mode.RGBD else None
                    yield Frame(k, k * 50_000_000, picture(k), right, depth, f"rgb/{k}.jpg")
            finally:
                closed.append(True)

        truth = GroundTruth(np.arange(4, dtype=np.int64) * 50_000_000, np.tile(np.eye(4), (4, 1, 1)))
        return SynthSequence("loop", Rig(Camera(32, 24, 30, 30, 16, 12)), mode, 4, truth, make)

    def test_the_simulator_only_sees_the_name(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked: list[str] = []
        closed: list[bool] = []

        def open_synth(spec: str) -> SynthSequence:
            asked.append(spec)
            return self.sequence(Mode.RGBD, closed)

        monkeypatch.setattr("seamark.datasets_synth.scenario.open_synth", open_synth)
        source = open_sources(["synth:loop,seed=3"])
        assert asked == ["loop,seed=3"]
        assert (source.name, source.mode, source.n_frames, source.period_ns) == ("loop", Mode.RGBD, 4, 50_000_000)
        assert source.modes == (Mode.RGBD, Mode.MONO, Mode.PLACES)
        assert source.ground_truth is not None
        got = frames(source)
        assert [frame.stamp_ns for frame in got] == [0, 50_000_000, 100_000_000, 150_000_000]
        assert isinstance(got[0], Frame)
        assert got[0].depth is not None
        closed.clear()
        mono = open_sources(["synth:loop"], mode="mono").frames()
        first = next(mono)
        assert isinstance(first, Frame)
        assert first.depth is None
        mono.close()  # type: ignore[attr-defined]
        assert closed == [True]


class TestWhatCannotBeOpened:
    def test_each_is_told(self, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        make_images(tmp_path / "i", ["0.png"])
        (tmp_path / "x.txt").write_text("")
        for spec, message in [
            (tmp_path / "nowhere", "does not exist"),
            (tmp_path / "empty", "neither a data set"),
            (tmp_path / "i" / "0.png", "one image"),
            (tmp_path / "x.txt", "neither a folder nor a video"),
            ("synth:", "names no world"),
        ]:
            with pytest.raises(SourceError, match=message):
                open_sources([str(spec)])
        with pytest.raises(SourceError, match="no source"):
            open_sources([])
        with pytest.raises(SourceError, match="frames per second must be within"):
            open_sources([str(tmp_path / "i")], fps=0)
        with pytest.raises(SourceError, match="'fast' is not a mode"):
            open_sources([str(tmp_path / "i")], mode="fast")


class TestDecoding:
    def test_depth_in_metres_keeps_nan(self, tmp_path: Path) -> None:
        depth = np.full((24, 32), 1.5, np.float32)
        depth[3, 4] = np.nan
        write(tmp_path / "d.tiff", depth)
        got = read_depth(tmp_path / "d.tiff")
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, depth)

    def test_depth_with_colour_is_refused(self, tmp_path: Path) -> None:
        write(tmp_path / "d.png", picture(colour=True))
        with pytest.raises(UnreadableImageError, match="3 channels"):
            read_depth(tmp_path / "d.png")

    def test_stored_forms(self, tmp_path: Path) -> None:
        grey = picture(3)
        write(tmp_path / "g.png", grey)
        write(tmp_path / "s.png", grey.astype(np.uint16) * 257)
        write(tmp_path / "a.png", np.dstack([picture(3, colour=True), np.full_like(grey, 9)]))
        write(tmp_path / "f.tiff", (grey / 255).astype(np.float32))
        np.testing.assert_array_equal(read_image(tmp_path / "g.png"), grey)
        np.testing.assert_array_equal(read_image(tmp_path / "s.png"), grey)
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), picture(3, colour=True))
        np.testing.assert_array_equal(read_image(tmp_path / "f.tiff"), grey)

    @pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
    def test_every_cut_of_a_jpeg_is_noticed(self, options: list[int]) -> None:
        data = cv2.imencode(".jpg", picture(colour=True), options)[1].tobytes()
        assert jpeg_complete(data)
        assert jpeg_complete(data + bytes(16))
        # A thumbnail with its own end marker, as cameras put into the APP1 segment.
        thumbnail = b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
        assert jpeg_complete(data[:2] + thumbnail + data[2:])
        for cut in range(len(data) - 1):
            assert not jpeg_complete(data[:cut])
            assert not jpeg_complete(data[:2] + thumbnail + data[2 : max(cut, 2)])

    def test_natural_order(self) -> None:
        names = ["b2", "b10", "b1", "B3", "10", "9", "b02"]
        assert sorted(names, key=natural_key) == ["9", "10", "b1", "b02", "b2", "B3", "b10"]
