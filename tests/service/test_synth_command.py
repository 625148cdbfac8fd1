"""``seamark synth``: what it lists exists, and what it writes is read back by the sources and by ``seamark run``."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from seamark.datasets_synth.scenario import open_synth
from seamark.frontend import se3
from seamark.frontend.types import Frame, Mode
from seamark.service import synth
from seamark.service.cli import app
from seamark.service.sources.open import open_sources

CASES = [("tum", "rgbd"), ("tum", "mono"), ("euroc", "stereo"), ("euroc", "mono"), ("kitti", "stereo")]


def _likeness_db(a: np.ndarray, b: np.ndarray) -> float:
    """The signal-to-noise ratio in grey, because JPEG keeps colours at half the resolution."""
    return float(cv2.PSNR(cv2.cvtColor(a, cv2.COLOR_BGR2GRAY), cv2.cvtColor(b, cv2.COLOR_BGR2GRAY)))


@pytest.mark.parametrize(("layout", "sensors"), CASES)
def test_what_is_written_is_read_back(layout: str, sensors: str, tmp_path: Path) -> None:
    options = synth.RenderOptions("toy", trajectory="hand_held", sensors=sensors, seed=5, frames=3)
    synth.render(options, layout, tmp_path / "out")
    source = open_sources([str(tmp_path / "out")])
    expected = open_synth("toy,trajectory=hand_held,seed=5,frames=3,sensors=" + sensors)
    assert source.mode is Mode(sensors)
    assert source.n_frames == 3
    assert source.rig is not None
    assert np.allclose(source.rig.cam0.K, expected.rig.cam0.K)
    assert not source.rig.cam0.distorted
    if sensors == "stereo":
        assert source.rig.T_cam0_cam1 == pytest.approx(expected.rig.T_cam0_cam1, abs=1e-9)
    for got, true in zip(source.frames(), expected.frames(), strict=True):
        assert isinstance(got, Frame)
        assert 33 < _likeness_db(got.image, true.image) < 60  # JPEG
        if true.image_right is not None:
            assert got.image_right is not None
            assert _likeness_db(got.image_right, true.image_right) > 33
        if true.depth is not None:
            assert got.depth is not None
            assert np.abs(got.depth / source.rig.depth_factor - true.depth).max() < 0.00011
    truth = source.ground_truth
    assert truth is not None and source.stamps_ns is not None
    rows = np.searchsorted(truth.stamps_ns, source.stamps_ns)
    assert np.array_equal(truth.stamps_ns[rows], source.stamps_ns)
    first = expected.ground_truth.T_world_cam[0] if layout == "kitti" else np.eye(4)
    assert np.allclose(truth.T_world_cam[rows], se3.inverse(first) @ expected.ground_truth.T_world_cam, atol=1e-6)
    assert np.array_equal(np.diff(source.stamps_ns), np.diff(expected.ground_truth.stamps_ns))


def test_the_list_names_what_render_takes(tmp_path: Path) -> None:
    runner = CliRunner()
    listed = json.loads(runner.invoke(app, ["synth", "list", "--json"]).stdout)
    assert {world["name"] for world in listed["worlds"]} >= {"loop", "toy"}
    assert {"loop", "kidnap", "six_dof"} <= set(listed["trajectories"])
    assert [one["number"] for one in listed["scenarios"]] == list(range(1, len(listed["scenarios"]) + 1))
    plain = runner.invoke(app, ["synth", "list"])
    assert plain.exit_code == 0
    for one in listed["scenarios"]:
        assert one["name"] in plain.stdout


def test_an_unnamed_sensor_is_the_richest_of_the_layout(tmp_path: Path) -> None:
    made = synth.render(synth.RenderOptions("toy,seed=1", frames=2), "euroc", tmp_path / "out")
    assert made["synth"] == "toy,frames=2,seed=1,sensors=stereo,sensor=mild,trajectory=loop"
    assert synth.RenderOptions("lap", frames=50).text("tum").startswith("loop,sensors=rgbd,frames=50")


def test_render_and_run_from_the_command_line(tmp_path: Path) -> None:
    runner = CliRunner()
    out = tmp_path / "toy"
    arguments = ["synth", "render", "toy", "--trajectory", "line", "--frames", "20", "--out", str(out)]
    rendered = runner.invoke(app, [*arguments, "--json"])
    assert json.loads(rendered.stdout)["resumed"] == 0
    assert "20 of them from before" in runner.invoke(app, arguments).stdout
    result = runner.invoke(app, ["run", str(out), "--in-process", "--no-loops", "--out", str(tmp_path / "r"), "--json"])
    assert result.exit_code == 0
    lines = (tmp_path / "r" / "odometry.tum").read_text().splitlines()
    positions = np.array([line.split()[1:4] for line in lines if line[0] != "#"], np.float64)
    assert len(positions) == 20
    way = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert way == pytest.approx(19 * 0.04, rel=0.05)
