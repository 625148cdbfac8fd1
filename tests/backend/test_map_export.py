"""Exports, read back by others: GTSAM, pycolmap, and the readers of trajectories."""

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pycolmap
import pytest

from seamark.backend.errors import MapError
from seamark.backend.map_export import Format, export_map
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth
from seamark.service.trajectory_files import load_euroc, load_kitti, load_tum

COUNT = 8
STAMP_NS = 1_403_715_273_262_142_976


@pytest.fixture(scope="module")
def true_poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (COUNT + 1, 1, 1))
    for number in range(COUNT):
        angle = 0.03 * number
        poses[number, :3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        poses[number, :3, 3] = (0.1 * number, 0.02 * number, 0.05 * number)
    return poses


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, true_poses: np.ndarray, world, distorted):
    """Eight views of one world with true landmarks, and a ninth of another session that is joined to nothing."""
    path = tmp_path_factory.mktemp("scene") / "map.seamark"
    seen = world(3, 600)
    with MapStore(path) as store:
        for number, T in enumerate(true_poses):
            keyframe = seen.view(T, distorted, noise_px=0.3, clutter=40)
            last = number == COUNT
            store.add_keyframe(
                replace(
                    keyframe,
                    id=number,
                    session=int(last),
                    stamp_ns=STAMP_NS + 100_000_000 * number,
                    previous_id=None if last or number == 0 else number - 1,
                    T_odom_cam=T,
                    covariance=np.diag([1e-4] * 3 + [4e-4] * 3),
                )
            )
        T_0_7 = np.linalg.inv(true_poses[0]) @ true_poses[7]
        store.add_loop(Loop(7, 0, True, Reason.ACCEPTED, 90, 0.5, 0.5, 0.5, T_0_7, np.diag([1e-4] * 3 + [9e-4] * 3)))
        store.add_loop(Loop(6, 0, False, Reason.UNCONFIRMED, 20, 0.5, 0.5, 0.5, np.eye(4), np.eye(6)))
        ids = np.arange(COUNT + 1)
        sessions = np.where(ids == COUNT, 1, 0)
        store.update_poses(MapSnapshot(1, ids, sessions, sessions, true_poses, np.ones(COUNT + 1), ()))
    return path, seen


@pytest.mark.parametrize("form, load", [(Format.TUM, load_tum), (Format.KITTI, load_kitti), (Format.EUROC, load_euroc)])
def test_trajectories_are_those_of_the_keyframes(form, load, scene, true_poses, tmp_path) -> None:
    path, _ = scene
    assert export_map(path, tmp_path / "out", form) == {"poses": COUNT}
    trajectory = load(tmp_path / "out")
    np.testing.assert_allclose(trajectory.T_world_cam, true_poses[:COUNT], atol=1e-7)
    if form is not Format.KITTI:
        assert trajectory.stamps_ns.tolist() == [STAMP_NS + 100_000_000 * n for n in range(COUNT)]
    with pytest.raises(MapError, match="exists"):
        export_map(path, tmp_path / "out", form)
    assert export_map(path, tmp_path / "other", form, component=1) == {"poses": 1}
    with pytest.raises(MapError, match="no keyframes"):
        export_map(path, tmp_path / "none", form, component=7)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["other", "out"]


def test_the_pose_graph_is_read_by_gtsam(scene, true_poses, tmp_path) -> None:
    path, _ = scene
    counts = export_map(path, tmp_path / "map.g2o", Format.G2O)
    assert counts == {"vertices": COUNT, "odometry_edges": COUNT - 1, "loop_edges": 1}
    graph, values = gtsam.readG2o(str(tmp_path / "map.g2o"), True)
    assert graph.size() == COUNT and values.size() == COUNT
    for number in range(COUNT):
        np.testing.assert_allclose(values.atPose3(number).matrix(), true_poses[number], atol=1e-7)
    assert graph.error(values) < 1e-9  # all edges hold between the true poses
    loop = graph.at(COUNT - 1)
    assert list(loop.keys()) == [0, 7]
    np.testing.assert_allclose(loop.noiseModel().sigmas(), [1e-2] * 3 + [3e-2] * 3, rtol=1e-3)


def test_the_colmap_model_opens_in_pycolmap_and_its_points_project_where_they_were_seen(
    scene, true_poses, tmp_path
) -> None:
    path, world = scene
    counts = export_map(path, tmp_path / "model", Format.COLMAP)
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path / "model"))
    assert model.num_images() == counts["images"] == COUNT and model.num_cameras() == counts["cameras"] == 1
    assert model.num_points3D() == counts["points"] and 100 < counts["points"] < 1200
    names = {image.name for image in model.images.values()}
    assert names == {one.name for one in (tmp_path / "model" / "images").iterdir()}
    errors, seen = [], 0
    for image in model.images.values():
        T = np.linalg.inv(true_poses[image.image_id])
        np.testing.assert_allclose(image.cam_from_world().matrix(), T[:3], atol=1e-6)
        for point in image.points2D:
            if point.has_point3D():
                seen += 1
                projected = image.project_point(model.points3D[point.point3D_id].xyz)
                errors.append(np.linalg.norm(projected - point.xy))
    assert seen == sum(point.track.length() for point in model.points3D.values())
    # Key points were displaced by 0.3 px in x and in y: their distance has a median of 0.35 px.
    assert 0.25 < np.median(errors) < 0.45 and np.mean(np.array(errors) < 5) > 0.98
    positions = np.array([point.xyz for point in model.points3D.values()])
    nearest = np.linalg.norm(positions[:, None] - world.points[None], axis=2).min(axis=1)
    assert np.mean(nearest < 1e-3) > 0.95  # the landmarks are true
    assert max(point.track.length() for point in model.points3D.values()) == COUNT


def test_the_point_cloud_is_that_of_the_world(scene, tmp_path) -> None:
    path, world = scene
    counts = export_map(path, tmp_path / "map.ply", Format.PLY)
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert f"element vertex {counts['points']}\n".encode() in header
    points = np.frombuffer(body, "<f4").reshape(-1, 3)
    assert len(points) == counts["points"] > 300
    distances = np.linalg.norm(points[:, None] - world.points[None].astype(np.float32), axis=2)
    true = distances.min(axis=1) < 1e-2
    assert 0.3 < true.mean() <= 1  # the rest is the clutter of each view
    assert (distances.min(axis=0) < 1e-2).sum() > 250


def test_the_dense_point_cloud_is_the_wall_that_was_seen_in_its_colour(tmp_path, make_keyframe, ideal) -> None:
    """Test: a wall at z = 3 seen from two places, and a keyframe without depth. Expected: all points on it, orange."""
    orange = np.full((480, 640, 3), (20, 120, 240), np.uint8)
    jpeg = cv2.imencode(".jpg", orange)[1].tobytes()
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [(0, 0, 0), (0.5, 0.25, 0.5), (9, 9, 9)]
    with MapStore(tmp_path / "map.seamark") as store:
        for number, T_map_cam in enumerate(T):
            depth = np.full((480, 640), 3 - T_map_cam[2, 3], np.float32)
            png = encode_depth(depth, 1.0, FrontendConfig(keyframe_depth_px=160)) if number < 2 else b""
            keyframe = replace(make_keyframe(number), T_odom_cam=T_map_cam, camera=ideal, jpeg=jpeg, depth=png)
            store.add_keyframe(keyframe)
        store.update_poses(MapSnapshot(1, np.arange(3), np.ones(3, int), np.ones(3, int), T, np.ones(3), ()))
    counts = export_map(tmp_path / "map.seamark", tmp_path / "map.ply", Format.PLY, dense=True)
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert header.count(b"property float") == 3 and header.count(b"property uchar") == 3
    names = ("x", "y", "z", "red", "green", "blue")
    points = np.frombuffer(body, list(zip(names, ["<f4"] * 3 + ["u1"] * 3, strict=True)))
    assert len(points) == counts["points"] > 2 * 0.85 * 160 * 120
    np.testing.assert_allclose(points["z"], 3, atol=0.01)
    assert points["x"].min() < -1.7 and points["x"].max() > 1.9
    for name, value in zip(names[3:], (240, 120, 20), strict=True):
        np.testing.assert_allclose(points[name].astype(int), value, atol=4)
