"""The lap of the world loop and the sensor model, without a simulator."""

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import specification, trajectory, world_loop
from seamark.datasets_synth.sensor import MODELS, CodedFrame, code_depth, code_picture, decode, expose, measure_depth
from seamark.frontend import se3


class TestPath:
    @pytest.mark.parametrize("seed", [0, 3])
    def test_full_lap_is_long_closed_and_slow_in_turns(self, seed: int) -> None:
        poses = specification.parse(f"loop,seed={seed}").poses()
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        assert 60 < steps.sum() < 75
        assert steps.max() < 0.15
        turns = se3.rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
        assert np.rad2deg(turns.max()) < 2.5
        assert np.allclose(np.swapaxes(poses[:, :3, :3], 1, 2) @ poses[:, :3, :3], np.eye(3), atol=1e-12)
        again = [int(np.argmin(np.linalg.norm(poses[:60, :3, 3] - pose[:3, 3], axis=1))) for pose in poses[575:]]
        for late, early in zip(poses[575:], again, strict=True):
            relative = se3.inverse(poses[early]) @ late
            assert np.linalg.norm(relative[:3, 3]) < 0.35
            assert np.rad2deg(se3.rotation_angle(relative[:3, :3])) < 12

    @pytest.mark.parametrize("size", ["full", "small"])
    def test_camera_keeps_clear_of_everything(self, size: str) -> None:
        plan = world_loop.PLANS[size]
        positions = world_loop.loop_poses(plan, 300, 0)[:, :3, 3]
        for panel in world_loop.build_loop(plan, 0).panels:
            along = [(positions - panel.corner) @ edge / (edge @ edge) for edge in (panel.right, panel.down)]
            nearest = panel.corner + sum(
                np.clip(share, 0, 1)[:, None] * edge
                for share, edge in zip(along, (panel.right, panel.down), strict=True)
            )
            assert np.linalg.norm(positions - nearest, axis=1).min() > 0.3

    def test_stamps_are_regular(self) -> None:
        assert np.all(np.abs(np.diff(trajectory.stamps(50, 15.0)) - 1e9 / 15) <= 1)


class TestSensor:
    def test_depth_noise_grows_with_the_square_of_the_distance(self) -> None:
        for metres in (1.0, 2.0, 4.0):
            plane = np.full((240, 320), metres, np.float32)
            raw = measure_depth(plane, np.zeros_like(plane), MODELS["mild"], np.random.default_rng(0), 205.0)
            error = raw / 5000 - metres
            assert error.std() == pytest.approx(np.hypot(0.001 * metres**2, 0.001 / 12**0.5), rel=0.12)
            assert abs(error.mean()) < 0.1 * error.std() + 1e-5

    def test_a_cheap_camera_errs_in_the_same_way_in_all_frames(self) -> None:
        model, plane = MODELS["cheap"], np.full((240, 320), 3.0, np.float32)
        field = model.distortion_field(240, 320, seed=1)
        assert field.std() == pytest.approx(0.03, rel=0.01)
        assert abs(field.mean()) < 1e-4
        frames = [measure_depth(plane, field, model, np.random.default_rng(k), 205.0) / 5000 for k in range(40)]
        assert np.abs(np.mean(frames, axis=0) / 3 - 1 - field * 3 / 4).mean() < 0.002
        assert np.abs(np.diff(field, axis=1)).max() < 0.004
        assert not MODELS["mild"].distortion_field(240, 320, seed=1).any()

    def test_depth_out_of_range_is_zero(self) -> None:
        depth = np.array([[0.0, 0.2, 0.5, 7.5, 9.0, 30.0]], np.float32).repeat(9, axis=1).repeat(16, axis=0)
        raw = measure_depth(depth, np.zeros_like(depth), MODELS["mild"], np.random.default_rng(0), 205.0)
        assert np.array_equal(raw[0, 4::9] > 0, [False, False, True, True, False, False])

    def test_there_are_holes_left_of_near_things_and_along_edges(self) -> None:
        depth = np.full((60, 320), 4.0, np.float32)
        depth[20:40, 150:200] = 1.0
        raw = measure_depth(depth, np.zeros_like(depth), MODELS["cheap"], np.random.default_rng(0), 410.0)
        shadow = 0.075 * 410 * (1 - 1 / 4)  # disparity of the near thing to the projector, less that of the wall
        for row in (25, 30, 35):
            gone = np.flatnonzero(raw[row] == 0)
            left = gone[gone < 152]
            assert np.array_equal(left, np.arange(left[0], 151))
            assert 150 - left[0] == pytest.approx(shadow, abs=1.5)
            assert set(gone[gone > 152]) == {199, 200}
        assert set(np.flatnonzero(raw[:, 170] == 0)) == {19, 20, 39, 40}
        assert (raw[5:15] > 0).all()

    def test_a_slanting_wall_has_no_holes(self) -> None:
        x = (np.arange(320, dtype=np.float32) - 159.5) / 205
        for aside in (1.2, -1.2):  # a wall 1.2 m beside the camera, along its view
            depth = np.where(aside * x > 1.2 * 0.16, aside / x, 7.5).astype(np.float32)
            raw = measure_depth(
                np.tile(depth, (9, 1)), np.zeros((9, 320), np.float32), MODELS["mild"], np.random.default_rng(0), 205.0
            )
            assert (raw > 0).all()

    def test_an_ideal_camera_is_exact(self) -> None:
        depth = np.random.default_rng(1).uniform(0.1, 13.0, (24, 32)).astype(np.float32)
        model = MODELS["ideal"]
        raw = measure_depth(depth, model.distortion_field(24, 32, 0), model, np.random.default_rng(0), 205.0)
        assert 0 < np.abs(raw / 5000 - depth).max() < 0.000101
        picture = np.random.default_rng(2).uniform(0, 255, (24, 32, 3)).astype(np.float32)
        assert np.array_equal(expose(picture, model, np.random.default_rng(0)), np.rint(picture).astype(np.uint8))

    def test_broken_files_are_errors(self) -> None:
        with pytest.raises(SeamarkError, match=r"picture of rendered frame rgb/1\.jpg"):
            decode(CodedFrame(1, b""), 0, "rgb/1.jpg")
        left, depth = code_picture(np.zeros((8, 8, 3), np.uint8)), code_depth(np.zeros((8, 8), np.uint16))
        with pytest.raises(SeamarkError, match="depth of rendered frame"):
            decode(CodedFrame(1, left, b"", depth[: len(depth) // 2]), 0, "rgb/1.jpg")
