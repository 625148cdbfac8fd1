"""Folders of synthetic sequences: resumable, complete or absent, with readings that agree with the truth."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import rendering, scenarios, toy_names, writing
from seamark.datasets_synth.scenario import open_synth
from seamark.datasets_synth.sensor import CodedFrame, code_picture
from seamark.datasets_synth.writing import write_sequence
from seamark.frontend import se3

SPEC = "toy,frames=4,seed=2"


def _files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_same_seed_same_bits_and_nothing_to_do_twice(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    first = write_sequence(SPEC, "tum", tmp_path / "a", lambda done, total: seen.append((done, total)))
    assert seen == [(k, 4) for k in range(1, 5)]
    assert (first.frames, first.resumed) == (4, 0)
    write_sequence(SPEC, "tum", tmp_path / "b")
    assert _files(tmp_path / "a") == _files(tmp_path / "b")
    again = write_sequence(SPEC, "tum", tmp_path / "a", lambda *_: pytest.fail("nothing was to be done"))
    assert again.resumed == 4
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


def test_an_interrupted_rendering_goes_on(tmp_path: Path) -> None:
    def interrupt(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence(f"{SPEC},sensors=stereo", "euroc", tmp_path / "a", interrupt)
    assert not (tmp_path / "a").exists()
    (tmp_path / ".a.partial" / "mav0" / "cam0" / "data" / ".torn.png.new").write_bytes(b"half a pict")
    seen: list[int] = []
    written = write_sequence(f"{SPEC},sensors=stereo", "euroc", tmp_path / "a", lambda done, _: seen.append(done))
    assert written.resumed == 2
    assert seen == [3, 4]
    (tmp_path / "a" / "mav0" / "cam0" / "data" / ".torn.png.new").unlink()
    write_sequence(f"{SPEC},sensors=stereo", "euroc", tmp_path / "b")
    assert _files(tmp_path / "a") == _files(tmp_path / "b")


def test_what_another_sequence_left_is_not_mixed_in(tmp_path: Path) -> None:
    def interrupt(done: int, _: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sequence("toy,frames=8,seed=3", "tum", tmp_path / "a", interrupt)
    assert write_sequence(SPEC, "tum", tmp_path / "a").resumed == 0
    write_sequence(SPEC, "tum", tmp_path / "b")
    assert _files(tmp_path / "a") == _files(tmp_path / "b")


def test_refusals_are_sentences(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for spec, layout, target, message in (
        (SPEC, "tum", tmp_path / "full", "holds something else already"),
        (SPEC, "tum", tmp_path / "file", "holds something else already"),
        (SPEC, "tum", tmp_path / "file" / "below", "cannot be written"),
        (SPEC, "rosbag", tmp_path / "new", "no layout 'rosbag'; there are tum, euroc, kitti"),
        (SPEC, "kitti", tmp_path / "new", "layout kitti carries stereo or mono, not sensors=rgbd"),
        ("toy,sensors=stereo", "tum", tmp_path / "new", "layout tum carries rgbd or mono"),
        ("loop,camera=barrel,sensors=mono", "kitti", tmp_path / "new", "knows no distortion"),
        ("toy,condition=night", "tum", tmp_path / "new", "no setting 'condition=night'"),
        ("toy,trajectory=figure_eight", "tum", tmp_path / "new", "no trajectory 'figure_eight'; there are loop"),
        ("toy,frames", "tum", tmp_path / "new", "'frames' is not key=value"),
        ("toy,frames=9,frames=8", "tum", tmp_path / "new", "given twice"),
        ("atlantis", "tum", tmp_path / "new", "no synthetic world 'atlantis'"),
        ("small_loop", "tum", tmp_path / "new", "small_loop is kept in layout tum at /"),
        ("small_loop,sensors=rgbd", "tum", tmp_path / "new", "small_loop is kept in layout tum at /"),
        ("loop,size=small,trajectory=lawn_mower", "tum", tmp_path / "new", "needs an open area"),
    ):
        with pytest.raises(SeamarkError, match=message) as caught:
            write_sequence(spec, layout, target)
        assert "\n" not in str(caught.value)
    assert (tmp_path / "full" / "thesis.txt").read_text() == "mine"
    assert not (tmp_path / "new").exists()


def test_two_processes_do_not_write_one_folder(tmp_path: Path) -> None:
    def second(done: int, _: int) -> None:
        if done == 1:
            with pytest.raises(SeamarkError, match="being written by another process"):
                write_sequence(SPEC, "tum", tmp_path / "a")

    write_sequence(SPEC, "tum", tmp_path / "a", second)


def test_without_vulkan_rendered_worlds_are_refused_and_the_toy_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "COMMAND", (sys.executable, "-c", "raise SystemExit('no device')"))
    with pytest.raises(rendering.NoVulkanDevice, match="no usable Vulkan device") as caught:
        write_sequence("loop,frames=4", "tum", tmp_path / "a", cache_dir=tmp_path / "cache")
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
    write_sequence(SPEC, "tum", tmp_path / "a")


def test_a_rendered_world_resumes_at_its_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The renderer is asked for the frames that are missing and for no others."""
    begins: list[int] = []

    class Pool:
        def __init__(self, wanted: object, begin: int) -> None:
            begins.append(begin)
            self.begin = begin

        def __enter__(self) -> "Pool":
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def frames(self) -> list[CodedFrame]:
            picture = np.zeros((48, 64, 3), np.uint8)
            made = range(self.begin, 6)
            return [CodedFrame(k, code_picture(picture + np.uint8(k)), labels=b"%d" % k) for k in made]

    def interrupt(done: int, _: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(writing, "RenderPool", Pool)
    monkeypatch.setattr(writing, "require_renderer", lambda: "")
    spec = "loop,frames=6,sensors=mono"
    with pytest.raises(KeyboardInterrupt):
        write_sequence(spec, "kitti", tmp_path / "a", interrupt, cache_dir=tmp_path)
    assert write_sequence(spec, "kitti", tmp_path / "a", cache_dir=tmp_path).resumed == 4
    assert begins == [0, 4]
    values = [int(cv2.imread(str(tmp_path / "a" / "image_0" / f"{k:06d}.png"))[0, 0, 0]) for k in range(6)]
    assert values == list(range(6))
    assert (tmp_path / "a" / "labels" / "000003.png").read_bytes() == b"3"
    assert json.loads((tmp_path / "a" / "synth.json").read_text())["synth"].startswith("loop,frames=6,seed=0")


def test_written_readings_agree_with_the_truth(tmp_path: Path) -> None:
    write_sequence("toy,frames=60,sensors=mono,trajectory=stop_and_go", "euroc", tmp_path / "a")
    mav = tmp_path / "a" / "mav0"
    truth = np.loadtxt(mav / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    imu = np.loadtxt(mav / "imu0" / "data.csv", delimiter=",")
    assert np.allclose(np.diff(imu[:, 0]), 5e6, atol=300)  # stamps are rounded by the reading of floats
    assert abs(np.linalg.norm(imu[:, 4:], axis=1).mean() - 9.81) < 0.15
    steps = np.diff(truth[:, 0]) / 1e9
    moved = np.cumsum(0.5 * (truth[1:, 8:11] + truth[:-1, 8:11]) * steps[:, None], axis=0)
    assert np.abs(moved - (truth[1:, 1:4] - truth[0, 1:4])).max() < 0.002
    poses = open_synth("toy,frames=60,sensors=mono,trajectory=stop_and_go").ground_truth
    rows = np.searchsorted(truth[:, 0], poses.stamps_ns - 1000)
    body = poses.T_world_cam @ se3.inverse(se3.T_WORLD_LEVEL_CAM)
    assert np.allclose(truth[rows, 1:4], body[:, :3, 3], atol=1e-7)
    ticks = np.loadtxt(mav / "wheels0" / "data.csv", delimiter=",")[:, 1:]
    length = np.linalg.norm(np.diff(body[:, :2, 3], axis=0), axis=1).sum()
    assert ticks[-1].mean() / 5000 == pytest.approx(length, rel=0.05)
    fixes = np.loadtxt(mav / "gps0" / "data.csv", delimiter=",")
    assert 0 < np.abs(fixes[:, 1:3] - body[0, :2, 3]).max() < 8


class TestScenarios:
    def test_names_stand_for_sequences_that_exist(self) -> None:
        for number, scenario in enumerate(scenarios.SCENARIOS.values(), 1):
            assert scenario.number == number
            plan = writing._plan(scenario.name, Path("/nowhere"))
            assert 300 <= len(plan.truth) <= 800

    def test_the_documentation_has_the_same_table(self) -> None:
        text = (Path(__file__).parents[2] / "docs" / "trajectories.md").read_text(encoding="utf-8")
        rows = [line for line in text.splitlines() if line.startswith("| ") and line.split()[1].isdigit()]
        assert rows == [
            f"| {one.number} | `{one.name}` | `{one.text}` | {one.purpose} |" for one in scenarios.SCENARIOS.values()
        ]

    def test_settings_after_the_name_take_precedence(self) -> None:
        assert scenarios.expand("lap,frames=50") == "loop,frames=50,sensors=rgbd"
        assert scenarios.expand("loop,frames=50") == "loop,frames=50"
        with pytest.raises(SeamarkError, match="given twice"):
            scenarios.expand("lap,frames=50,frames=60")

    def test_the_toy_world_opens_by_name(self) -> None:
        sequence = open_synth("toy,frames=3,sensors=stereo,trajectory=hand_held")
        assert [frame.index for frame in sequence.frames()] == [0, 1, 2]
        assert sequence.rig.cam1 is not None
        plain = open_synth("toy,frames=50").ground_truth.T_world_cam
        assert np.linalg.norm(plain[:, :2, 3], axis=1) == pytest.approx(np.full(50, 2.4))
        assert toy_names.parse("toy").frames == 120
