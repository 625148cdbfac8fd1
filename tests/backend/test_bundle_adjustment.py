"""Full adjustment of poses and landmarks against a world of points whose poses are known."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from seamark.backend.bundle_adjustment import adjust
from seamark.backend.bundle_observations import Observations
from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapError, SolverError
from seamark.backend.map_open import restore
from seamark.backend.map_optimise import carried, optimise_map
from seamark.backend.map_store import MapStore
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.slam import Slam
from seamark.backend.tracks import find_tracks, neighbours
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend.types import Mode
from seamark.vocab.types import Candidates

CONFIG = BackendConfig()
COUNT = 8


def scene(world, move, metric=True, depth_noise=0.01, **options):
    """Keyframes that pass along a wall and back to the first; poses of a map that have drifted; the true ones."""
    w = world(5, 700)
    rng = np.random.default_rng(2)
    truth, poses, keyframes = [], {}, []
    for k in range(COUNT):
        s = min(k, COUNT - 1 - k) / 3.5
        truth.append(move((0, 0.05 * s, 0), (0.8 * s, 0.1 * (k % 2), 0.1 * k)))
        drift = move(tuple(0.002 * k * rng.normal(size=3)), tuple(0.006 * k * rng.normal(size=3)))
        poses[k] = truth[-1] @ drift
        keyframes.append(
            w.view(
                truth[-1],
                depth_noise=depth_noise,
                id=k,
                index=k,
                stamp_ns=k * 10**9,
                previous_id=k - 1 if k else None,
                T_odom_cam=poses[k],
                covariance=1e-4 * np.eye(6),
                metric=metric,
                **options,
            )
        )
    T = np.linalg.inv(truth[0]) @ truth[COUNT - 1]
    loop = Loop(COUNT - 1, 0, True, Reason.ACCEPTED, 200, 0.5, 0.4, 0.1, T, 1e-6 * np.eye(6))
    return keyframes, poses, np.array(truth), loop


def worst(poses, truth):
    """Largest errors (m, rad) of poses relative to the first."""
    motion = [np.linalg.inv(poses[0]) @ T for T in poses]
    true = [np.linalg.inv(truth[0]) @ T for T in truth]
    errors = [np.linalg.inv(a) @ b for a, b in zip(true, motion, strict=True)]
    angles = [np.arccos(np.clip((np.trace(E[:3, :3]) - 1) / 2, -1, 1)) for E in errors]
    return max(np.linalg.norm(E[:3, 3]) for E in errors), max(angles)


def test_drift_is_taken_out_to_the_noise(world, move):
    keyframes, poses, truth, loop = scene(world, move)
    before = worst([poses[k] for k in range(COUNT)], truth)
    result = adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [loop], CONFIG)
    after = worst(result.T_map_cam, truth)
    assert before[0] > 0.03
    assert after[0] < 0.25 * before[0]
    assert after[0] < 0.012  # odometry and loops count too, which err more than the points of this world
    assert after[1] < 0.3 * before[1]
    assert result.better
    assert result.keyframe_ids.tolist() == list(range(COUNT))
    assert result.rms_px[1] < result.rms_px[0]
    assert 0.4 < result.rms_px[1] < 0.8  # the world's noise is 0.5 px per coordinate, less what points take of it
    assert result.observations > 2 * result.landmarks > 400
    np.testing.assert_allclose(result.T_map_cam[0], poses[0], atol=1e-3)


def test_wrong_matches_and_wrong_depths_do_not_matter(world, move):
    keyframes, poses, truth, loop = scene(world, move, outliers=0.2)
    result = adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [loop], CONFIG)
    assert worst(result.T_map_cam, truth)[0] < 0.015
    assert result.rms_px[1] < 0.8


def test_without_scale_the_shape_is_found(world, move):
    """Test: landmarks in a unit of 0.5 m, no metric depth. Expected: the poses up to the scale of the map."""
    keyframes, poses, truth, loop = scene(world, move, metric=False, unit=0.5)
    poses = {k: np.block([[T[:3, :3], 2 * T[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]]) for k, T in poses.items()}
    T = loop.T_match_query.copy()
    T[:3, 3] *= 2
    result = adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [replace(loop, T_match_query=T)], CONFIG)
    a, b = result.T_map_cam[:, :3, 3], truth[:, :3, 3]
    a, b = a - a[0], b - b[0]
    scale = (a * b).sum() / (a * a).sum()
    assert 0.45 < scale < 0.55
    assert np.abs(scale * a - b).max() < 0.03


def test_scales_of_keyframes_that_have_drifted_are_found(world, move):
    """Test: landmarks in the metres of the world but the map says that their unit grows by 2 per cent per keyframe.
    Expected: one scale for all of them, within half a per cent, and none where all were metric.
    """
    keyframes, poses, _, loop = scene(world, move, metric=False)
    drifted = {k: 1.02 ** (k - 4) for k in poses}
    found = adjust(keyframes, poses, drifted, [loop], CONFIG).scales
    assert np.abs(found / np.median(found) - 1).max() < 0.005
    assert 0.9 < np.median(found) < 1.1
    keyframes, poses, _, loop = scene(world, move)
    assert adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [loop], CONFIG).scales.tolist() == [1.0] * COUNT


def test_warped_depth_is_found_out_by_parallax(world, move):
    """Test: inverse depths that are off by a slope over the image, 8 per cent at its sides. Expected: poses nearly as
    good as with straight depths (10 mm); where nobody looks for the warp they are 31 mm off.
    """
    keyframes, poses, truth, loop = scene(world, move, depth_noise=0.003)
    warped = []
    for keyframe in keyframes:
        across = keyframe.features.points[:, 0] / keyframe.camera.width - 0.5
        z = keyframe.landmarks[:, 2]
        factor = 1 / (1 + 0.16 * across * z / np.nanmedian(z))
        warped.append(replace(keyframe, landmarks=(keyframe.landmarks * factor[:, None]).astype(np.float32)))
    result = adjust(warped, poses, dict.fromkeys(poses, 1.0), [loop], CONFIG)
    assert worst(result.T_map_cam, truth)[0] < 0.015


def test_a_camera_that_only_turns_keeps_its_landmarks_where_depth_has_them(world, move):
    """Test: no parallax, so that the first round may put landmarks anywhere. Expected: all are ahead again, and explain
    what was seen to the noise.
    """
    w = world(5, 700)
    truth = [move((0, 0.06 * k, 0), (0, 0, 0)) for k in range(COUNT)]
    rng = np.random.default_rng(4)
    poses = {k: T @ move(tuple(rng.normal(0, 0.004, 3)), tuple(rng.normal(0, 0.004, 3))) for k, T in enumerate(truth)}
    keyframes = []
    for k, T in poses.items():
        own = {"id": k, "index": k, "stamp_ns": k * 10**9, "previous_id": k - 1 if k else None}
        keyframes.append(w.view(truth[k], depth_noise=0.01, **own, T_odom_cam=T, covariance=1e-4 * np.eye(6)))
    result = adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [], CONFIG)
    assert result.better and result.rms_px[1] < 0.8
    assert worst(result.T_map_cam, truth)[1] < 0.0015
    assert worst([poses[k] for k in range(COUNT)], truth)[1] > 0.004


def test_landmarks_that_parallax_has_lost_start_where_depth_has_them(world, move):
    keyframes, _poses, truth, _ = scene(world, move)
    known = {k.id: k for k in keyframes}
    pairs = neighbours(keyframes)
    tracks = find_tracks(
        known, pairs, {(q, m): np.linalg.inv(truth[m]) @ truth[q] for q, m in pairs}, CONFIG.verification
    )
    seen = Observations(known, tracks, dict.fromkeys(known, 1.0))
    values = seen.initial(dict(enumerate(truth)))
    before = seen.landmarks(values)
    for track, lost in ((0, (0.0, 0.0, -50.0)), (1, (1e6, 0.0, 1e6))):
        values.update(L(track), np.array(lost))
    assert np.isinf(seen.errors_px(values)[tracks.track == 0]).all()
    inverse = 1 / seen.points[:, 2]
    inverse[tracks.track == 2] = np.nan  # it has no depth that counts and stays where it is
    after = seen.landmarks(seen.placed_by(inverse, values))
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
    np.testing.assert_array_equal(after[2], before[2])
    assert seen.errors_px(seen.placed_by(inverse, values))[tracks.track == 0].max() < 5


def test_the_same_input_gives_the_same_bits(world, move):
    keyframes, poses, _, loop = scene(world, move)
    results = [adjust(keyframes, poses, dict.fromkeys(poses, 1.0), [loop], CONFIG).T_map_cam for _ in range(2)]
    assert results[0].tobytes() == results[1].tobytes()


def test_strangers_are_named(world, move):
    keyframes, poses, _, _ = scene(world, move)
    apart = [replace(keyframes[0]), replace(world(9).view(np.eye(4), id=1), session=0)]
    with pytest.raises(SolverError, match="too few"):
        adjust(apart, poses, dict.fromkeys(poses, 1.0), [], CONFIG)


def test_tracks_see_each_keyframe_once(world, move):
    keyframes, _poses, truth, _ = scene(world, move)
    known = {k.id: k for k in keyframes}
    pairs = neighbours(keyframes)
    assert pairs[:4] == [(1, 0), (2, 0), (2, 1), (3, 0)]
    true = {(q, m): np.linalg.inv(truth[m]) @ truth[q] for q, m in pairs}
    tracks = find_tracks(known, pairs, true, CONFIG.verification)
    seen = list(zip(tracks.track.tolist(), tracks.keyframe.tolist(), strict=True))
    assert len(seen) == len(set(seen))
    assert np.bincount(tracks.track).min() >= 2
    # A track is one point of the world: its descriptor is the same in all keyframes.
    for track in range(0, tracks.count, 25):
        rows = np.flatnonzero(tracks.track == track)
        words = {known[tracks.keyframe[r]].features.descriptors[tracks.feature[r]].tobytes() for r in rows}
        assert len(words) == 1


def assert_a_service_keeps(path, poses, keyframes):
    """A service that opens the map, takes in a keyframe and solves leaves the others where they are, within a mm."""
    copy = path.with_name("copy.seamark")
    copy.write_bytes(path.read_bytes())
    slam = Slam(CONFIG, Mode.RGBD, PoseGraph(CONFIG), 1)
    with MapStore(copy) as store:
        (adjustment,) = store.load_adjustments()
        assert adjustment.loops.keys() == {(COUNT - 1, 0)}
        known = [n for n in range(1, COUNT) if n not in (3, 4)]  # 3 has no features, so that 4 has no predecessor
        assert all(adjustment.poses[n].covariance is not None for n in known)
        assert all(np.linalg.eigvalsh(adjustment.poses[n].covariance).min() > 0 for n in known)
        store.set_meta({"mapped": str(COUNT - 1)})
        restore(slam, store)
    last = keyframes[-1]
    slam.step(replace(last, id=COUNT, previous_id=COUNT - 1), Candidates(COUNT, 0, ()))
    slam.finish()
    np.testing.assert_allclose(slam.snapshot().T_map_cam[:COUNT], poses, atol=1e-3)


def test_a_map_gets_a_new_revision_or_keeps_its_poses(world, move, tmp_path):
    keyframes, poses, truth, loop = scene(world, move)
    path = tmp_path / "map.seamark"
    ids, zeros = np.arange(COUNT), np.zeros(COUNT, int)
    with MapStore(path) as store, pytest.raises(MapError, match="no poses"):
        store.close()
        optimise_map(path, CONFIG)
    with MapStore(path) as store:
        for keyframe in keyframes:
            store.add_keyframe(keyframe)
        store.add_loop(loop)
        store.update_poses(MapSnapshot(7, ids, zeros, zeros, np.stack(list(poses.values())), np.ones(COUNT), ()))
        with store.file.writing() as database:
            database.execute("DELETE FROM features WHERE keyframe_id = 3")
    done = optimise_map(path, CONFIG)
    assert done.revision == 8
    assert worst(done.after, truth)[0] < 0.5 * worst(done.before, truth)[0]
    with MapStore(path, read_only=True) as store:
        assert store.meta()["revision"] == "8"
        stored = store.load_poses()
    np.testing.assert_allclose(np.stack([stored[k][0] for k in range(COUNT)]), done.after)
    # Keyframe 3 has no features any more: it moved along with its neighbour.
    np.testing.assert_allclose(
        np.linalg.inv(done.after[2]) @ done.after[3], np.linalg.inv(poses[2]) @ poses[3], atol=1e-9
    )
    assert carried({0: np.eye(4), 5: np.eye(4)}, {0: 2 * np.eye(4)}).keys() == {0, 5}
    assert_a_service_keeps(path, done.after, keyframes)
    again = optimise_map(path, CONFIG)
    assert np.abs(again.after - done.after).max() < 0.01
    assert again.revision in (None, 9)
