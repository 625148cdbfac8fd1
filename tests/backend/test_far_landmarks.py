"""Landmarks without a depth sensor, against points whose places are known."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.far_landmarks import measured_landmarks, with_far_landmarks
from seamark.backend.map_memory import KeyframeMemory
from seamark.backend.verify import Verification, verify
from seamark.backend.verify_candidates import FarLandmarkCache

CONFIG = VerificationConfig()
STILL = np.diag([1e-12] * 6)
WAY = [(0.0, 0.0, 0.0), (0.3, -0.1, 2.0), (0.5, 0.1, 4.0)]


@pytest.fixture
def street(world, move):
    """Three neighbouring keyframes without depth among points 12 to 40 m away, and the points' world."""
    w = world(5, 900, low=-14, high=14, near=12, far=40)
    poses = [move((0, 0.02 * k, 0), t) for k, t in enumerate(WAY)]
    keyframes = [
        w.view(T, depth=False, id=k, previous_id=k - 1 if k else None, T_odom_cam=T, covariance=STILL)
        for k, T in enumerate(poses)
    ]
    return w, poses, keyframes


def true_depths(w, T_world_cam, keyframe):
    """Depth (N,) of each feature, NaN for clutter: descriptors tell which point it is."""
    of = {d.tobytes(): k for k, d in enumerate(w.descriptors)}
    numbers = [of.get(d.tobytes(), -1) for d in keyframe.features.descriptors]
    z = ((w.points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3])[:, 2]
    return np.array([z[n] if n >= 0 else np.nan for n in numbers])


def test_depths_are_right_and_as_sure_as_they_say(street):
    w, poses, keyframes = street
    one = with_far_landmarks(keyframes[1], keyframes[:1], CONFIG)
    two = with_far_landmarks(keyframes[1], [keyframes[0], keyframes[2]], CONFIG)
    truth = true_depths(w, poses[1], keyframes[1])
    for found in (one, two):
        assert not found.known[np.isnan(truth)].any()
        errors = (1 / found.points[found.known, 2] - 1 / truth[found.known]) / found.sigma[found.known]
        assert 0.7 < np.sqrt((errors**2).mean()) < 1.3
        assert (found.sigma[found.known] * found.points[found.known, 2] <= 0.2 + 1e-9).all()
    assert 100 < one.known.sum() < two.known.sum() < len(truth)
    both = one.known & two.known
    assert (two.sigma[both] <= one.sigma[both]).all()
    rays = keyframes[1].camera.rays(keyframes[1].features.points)
    assert two.points[both] / two.points[both, 2:] == pytest.approx(rays[both], rel=1e-9)


def test_unsure_odometry_makes_depths_unsure(street):
    _, _, keyframes = street
    unsure = replace(keyframes[1], covariance=np.diag([1e-5] * 3 + [1e-4] * 3))
    sure, found = (with_far_landmarks(one, keyframes[:1], CONFIG) for one in (keyframes[1], unsure))
    both = sure.known & found.known
    assert 20 < both.sum() < sure.known.sum()
    assert (found.sigma[both] > 1.5 * sure.sigma[both]).all()


def test_neighbours_that_disagree_leave_a_feature_without_a_landmark(street, move):
    _, _, keyframes = street
    astray = replace(keyframes[2], T_odom_cam=keyframes[2].T_odom_cam @ move((0, 0, 0), (0, 0, 2.0)))
    alone = with_far_landmarks(keyframes[1], [keyframes[0]], CONFIG)
    found = with_far_landmarks(keyframes[1], [keyframes[0], astray], CONFIG)
    with_astray = with_far_landmarks(keyframes[1], [astray], CONFIG)
    seen_by_both = alone.known & with_astray.known
    assert seen_by_both.sum() > 50
    assert found.known[seen_by_both].mean() < 0.6


def test_what_was_measured_stays(street):
    w, poses, keyframes = street
    measured = w.view(poses[1], id=1, previous_id=0, T_odom_cam=poses[1], covariance=STILL)
    landmarks = measured.landmarks.copy()
    landmarks[landmarks[:, 2] > 20] = np.nan
    measured = replace(measured, landmarks=landmarks)
    found = with_far_landmarks(measured, [keyframes[0], keyframes[2]], CONFIG)
    before = measured_landmarks(measured)
    assert (found.points[before.known] == before.points[before.known]).all()
    assert np.isnan(found.sigma[before.known]).all()
    assert found.known.sum() > before.known.sum() + 30


def test_nothing_is_added_without_odometry_calibration_or_neighbours(street):
    _, _, keyframes = street
    bare = {"T_odom_cam": None}, {"camera": None}
    for changed in bare:
        assert not with_far_landmarks(replace(keyframes[1], **changed), keyframes[:1], CONFIG).known.any()
        assert not with_far_landmarks(keyframes[1], [replace(keyframes[0], **changed)], CONFIG).known.any()
    assert not with_far_landmarks(keyframes[1], [], CONFIG).known.any()
    standing = replace(keyframes[0], T_odom_cam=keyframes[1].T_odom_cam)
    assert with_far_landmarks(keyframes[1], [standing], CONFIG).known.sum() < 10


def test_a_pose_is_found_where_no_sensor_measured_depth(street, move):
    """Test: a view beside the middle keyframe, without depth. Expected: its place alone, with neighbours its pose."""
    w, poses, keyframes = street
    truth = move((0.02, -0.03, 0.01), (0.8, -0.2, 0.5))
    query = w.view(poses[1] @ truth, depth=False, id=9)
    alone = verify(query, keyframes[1], CONFIG, 1)
    assert isinstance(alone, Verification)
    assert alone.T_match_query is None
    known = {keyframe.id: keyframe for keyframe in keyframes}
    cache = FarLandmarkCache(CONFIG, KeyframeMemory(10**9))
    found = verify(query, keyframes[1], CONFIG, 1, lambda keyframe: cache.of(keyframe, known))
    assert isinstance(found, Verification)
    E = np.linalg.inv(truth) @ found.T_match_query
    error = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1], *(2 * E[:3, 3])]) / 2
    assert 1e-4 < np.linalg.norm(error[3:]) < 0.15
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.2
    assert 0.1 < error @ np.linalg.solve(found.covariance, error) < 20


def test_the_cache_asks_a_keyframes_neighbours_once(street):
    _, _, keyframes = street
    memory = CountingMemory()
    cache = FarLandmarkCache(CONFIG, memory)
    known = {keyframe.id: keyframe for keyframe in keyframes[:2]}
    first = cache.of(keyframes[1], known)
    assert cache.of(keyframes[1], known) is first
    assert memory.asked == [0]
    known[2] = keyframes[2]
    assert cache.of(keyframes[1], known).known.sum() > first.known.sum()
    assert memory.asked == [0, 0, 2]


class CountingMemory(KeyframeMemory):
    """Counts what is read."""

    def __init__(self):
        super().__init__(10**9)
        self.asked = []

    def whole(self, keyframe):
        self.asked.append(keyframe.id)
        return keyframe
