from pathlib import Path

import numpy as np
import pytest

from seamark.frontend import se3
from seamark.service.evaluation import (
    Alignment,
    EvaluationError,
    align,
    associate,
    ate,
    load_kitti,
    load_trajectory,
    load_tum,
    path_length,
    rpe,
)
from seamark.service.trajectory_files import TrajectoryError, load_euroc
from seamark.service.types import Trajectory

DATA = Path(__file__).parents[3] / "shared" / "data" / "trajectories"


def walk(count: int = 50, seed: int = 3) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = [np.eye(4)]
    for _ in range(count - 1):
        T.append(T[-1] @ se3.make(se3.exp_rotation(rng.normal(0, 0.1, 3)), rng.normal((1, 0, 0), 0.1)))
    return Trajectory(np.arange(count, dtype=np.int64) * 100_000_000, np.stack(T))


def moved(trajectory: Trajectory, scale: float, T: np.ndarray) -> Trajectory:
    out = T @ trajectory.T_world_cam
    out[:, :3, 3] = scale * trajectory.T_world_cam[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    return Trajectory(trajectory.stamps_ns, out)


@pytest.mark.real_data
@pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL DATA NOT TESTED: {DATA} is missing")
class TestPublishedFigures:
    def test_kitti_00(self) -> None:
        truth = load_kitti(DATA / "KITTI_00_gt.txt", DATA / "KITTI_00_gt_times.txt")
        orb = load_kitti(DATA / "KITTI_00_ORB.txt", DATA / "KITTI_00_gt_times.txt")
        sptam = load_kitti(DATA / "KITTI_00_SPTAM.txt", DATA / "KITTI_00_gt_times.txt")
        assert len(truth) == len(orb) == 4541
        assert path_length(truth) == pytest.approx(3724.2, abs=0.2)
        assert ate(orb, truth, "se3").translation_m.rmse == pytest.approx(1.303, abs=0.001)
        assert ate(orb, truth, "sim3").translation_m.rmse == pytest.approx(0.938, abs=0.001)
        assert ate(sptam, truth, "se3").translation_m.rmse == pytest.approx(3.74, abs=0.01)

    def test_freiburg1_xyz(self) -> None:
        truth = load_trajectory(DATA / "freiburg1_xyz-groundtruth.txt")
        orb = load_tum(DATA / "freiburg1_xyz-ORB_kf_mono.txt")
        rgbdslam = load_tum(DATA / "freiburg1_xyz-rgbdslam.txt")
        assert ate(orb, truth, Alignment.SIM3).translation_m.rmse == pytest.approx(0.0098, abs=0.0001)
        assert ate(rgbdslam, truth, Alignment.SE3).translation_m.rmse == pytest.approx(0.0135, abs=0.0001)


class TestAssociate:
    def test_pairs_nearest_one_to_one(self) -> None:
        a = np.array([0, 10, 20, 100], np.int64) * 1_000_000
        b = np.array([11, 13, 21, 500], np.int64) * 1_000_000
        i, j = associate(a, b, 0.02)
        # 0 -> 13 is within 20 ms and is what remains after the nearer pairs have been taken.
        assert list(zip(i, j, strict=True)) == [(0, 1), (1, 0), (2, 2)]

    def test_agrees_with_brute_force(self) -> None:
        rng = np.random.default_rng(5)
        a, b = rng.integers(0, 10**9, 60), rng.integers(0, 10**9, 90)
        differences = sorted((abs(int(x) - int(y)), i, j) for i, x in enumerate(a) for j, y in enumerate(b))
        expected: dict[int, int] = {}
        for difference, i, j in differences:
            if difference <= 20_000_000 and i not in expected and j not in expected.values():
                expected[i] = j
        i, j = associate(a, b, 0.02)
        assert dict(zip(i.tolist(), j.tolist(), strict=True)) == expected
        assert len(i) > 30

    def test_nothing_to_pair(self) -> None:
        i, j = associate(np.array([0]), np.array([10**9]))
        assert len(i) == len(j) == 0
        i, j = associate(np.zeros(0, np.int64), np.array([10**9]))
        assert len(i) == 0


class TestErrors:
    def test_alignment_takes_a_similarity_away(self) -> None:
        truth = walk()
        T = se3.make(se3.exp_rotation(np.array([0.3, -1.0, 2.0])), np.array([5.0, -3.0, 1.0]))
        estimate = moved(truth, 0.4, T)
        result = ate(estimate, truth, "sim3")
        assert result.translation_m.max < 1e-9
        assert result.scale == pytest.approx(2.5)
        assert result.pairs == 50
        assert ate(moved(truth, 1.0, T), truth, "se3").translation_m.max < 1e-9
        assert ate(estimate, truth, "se3").translation_m.rmse > 1

    def test_mirrored_points_still_give_a_rotation(self) -> None:
        points = walk().T_world_cam[:, :3, 3]
        similarity = align(points * (1, 1, -1), points, "sim3")
        assert np.linalg.det(similarity.R) == pytest.approx(1)

    def test_known_statistics_without_alignment(self) -> None:
        truth = walk(4)
        T = truth.T_world_cam.copy()
        T[:, 2, 3] += (0, 1, 2, 5)
        figures = ate(Trajectory(truth.stamps_ns, T), truth, "none").translation_m
        assert (figures.mean, figures.median, figures.max) == (2, 1.5, 5)
        assert figures.rmse == pytest.approx(np.sqrt(30 / 4))

    def test_relative_error_of_a_drift_is_the_drift(self) -> None:
        truth = walk()
        drift = se3.make(se3.exp_rotation(np.array([0, 0, np.radians(0.5)])), np.array([0.0, 0.02, 0.0]))
        T = [np.eye(4)]
        for k in range(1, len(truth)):
            T.append(T[-1] @ se3.inverse(truth.T_world_cam[k - 1]) @ truth.T_world_cam[k] @ drift)
        estimate = Trajectory(truth.stamps_ns, np.stack(T))
        result = rpe(estimate, truth)
        assert result.pairs == 49
        assert result.translation_m.rmse == pytest.approx(0.02)
        assert result.rotation_deg.rmse == pytest.approx(0.5)

    def test_relative_error_over_a_length(self) -> None:
        T = np.tile(np.eye(4), (11, 1, 1))
        T[:, 0, 3] = np.arange(11)
        stamps = np.arange(11, dtype=np.int64) * 10**9
        estimate = T.copy()
        estimate[:, 0, 3] *= 1.1
        result = rpe(Trajectory(stamps, estimate), Trajectory(stamps, T), segment_m=5.0)
        assert result.delta == "5 m"
        assert result.pairs == 6
        assert result.translation_m.mean == pytest.approx(0.5)
        assert rpe(Trajectory(stamps, estimate), Trajectory(stamps, T), "sim3", 5.0).translation_m.max < 1e-9
        with pytest.raises(EvaluationError, match="50 m"):
            rpe(Trajectory(stamps, estimate), Trajectory(stamps, T), segment_m=50.0)

    def test_what_cannot_be_compared_is_said(self) -> None:
        truth = walk()
        with pytest.raises(EvaluationError, match="ground truth"):
            ate(Trajectory(truth.stamps_ns + 10**12, truth.T_world_cam), truth)
        with pytest.raises(EvaluationError, match="too few"):
            ate(Trajectory(truth.stamps_ns[:2], truth.T_world_cam[:2]), truth)
        standing = Trajectory(truth.stamps_ns, np.tile(np.eye(4), (50, 1, 1)))
        with pytest.raises(EvaluationError, match="scale"):
            ate(standing, truth, "sim3")


class TestFiles:
    def test_tum_stamps_do_not_pass_through_floats(self, tmp_path: Path) -> None:
        path = tmp_path / "t.txt"
        path.write_text("# c\n1700000000.123456789 1 2 3 0 0 0 2\n1700000000.023456789 0 0 0 0 0 0.7071 0.7071\n")
        trajectory = load_trajectory(path)
        assert trajectory.stamps_ns.tolist() == [1700000000023456789, 1700000000123456789]
        assert trajectory.T_world_cam[1, :3, 3].tolist() == [1, 2, 3]
        np.testing.assert_allclose(trajectory.T_world_cam[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)

    def test_euroc_order_of_the_quaternion(self, tmp_path: Path) -> None:
        path = tmp_path / "data.csv"
        path.write_text("#time(ns),px,...\n1403715273262142976,1,2,3,0.7071,0,0,0.7071" + ",0" * 9 + "\n")
        trajectory = load_euroc(path)
        assert trajectory.stamps_ns.tolist() == [1403715273262142976]
        np.testing.assert_allclose(trajectory.T_world_cam[0, :3, 0], [0, 1, 0], atol=1e-12)
        assert len(load_trajectory(path)) == 1

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "no poses"),
            ("1 2 3\n", "3 columns"),
            ("1 0 0 0 0 0 0 1\n2 0 0 x 0 0 0 1\n", "line 2"),
            ("1 0 0 0 0 0 0 1\n2 0 0\n", "line 2"),
            ("one 0 0 0 0 0 0 1\n", "line 1"),
        ],
    )
    def test_malformed_files(self, tmp_path: Path, text: str, message: str) -> None:
        path = tmp_path / "t.txt"
        path.write_text(text)
        with pytest.raises(TrajectoryError, match=message):
            load_trajectory(path)

    def test_missing_file_and_unequal_times(self, tmp_path: Path) -> None:
        with pytest.raises(TrajectoryError, match=r"nowhere\.txt"):
            load_trajectory(tmp_path / "nowhere.txt")
        (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
        (tmp_path / "times.txt").write_text("0\n0.1\n")
        assert load_kitti(tmp_path / "poses.txt").stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
        with pytest.raises(TrajectoryError, match="3 poses"):
            load_kitti(tmp_path / "poses.txt", tmp_path / "times.txt")
