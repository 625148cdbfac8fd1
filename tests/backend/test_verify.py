"""Verification against cameras and points whose poses are known."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.matching import match_features
from seamark.backend.pose_errors import Observations, errors, linearise
from seamark.backend.refine_pose import worst_deviations
from seamark.backend.types import Reason
from seamark.backend.verify import Rejected, Verification, verify

CONFIG = VerificationConfig()
W, T = (0.03, -0.08, 0.05), (0.4, -0.2, 0.3)


def pose_errors(found, truth):
    E = np.linalg.inv(truth) @ found
    angle = np.arccos(np.clip((np.trace(E[:3, :3]) - 1) / 2, -1, 1))
    return np.rad2deg(angle), np.linalg.norm(E[:3, 3])


def test_matching_agrees_with_brute_force(world):
    w = world(3, 300)
    a, b = w.view(np.eye(4)), w.view(np.eye(4))
    matches = match_features(a.features, b.features, 0.85)
    D = np.linalg.norm(
        a.features.descriptors[:, None].astype(float) - b.features.descriptors[None].astype(float), axis=2
    )
    for i, j in zip(matches.query, matches.match, strict=True):
        row, column = np.sort(D[i]), np.sort(D[:, j])
        assert D[i, j] == row[0] == column[0]
        assert row[0] < 0.85 * row[1]
        assert column[0] < 0.85 * column[1]
    assert 50 < len(matches) <= 300


@pytest.mark.parametrize("outliers", [0.0, 0.4, 0.7])
@pytest.mark.parametrize("lens", ["ideal", "distorted"])
def test_pose_is_found_despite_outliers_and_distortion(world, move, request, lens, outliers):
    camera = request.getfixturevalue(lens)
    w, truth = world(1), move(W, T)
    match = w.view(np.eye(4), camera, depth_noise=0.005)
    query = w.view(truth, camera, depth_noise=0.005, outliers=outliers)
    result = verify(query, match, CONFIG, 5)
    assert isinstance(result, Verification)
    angle_deg, distance = pose_errors(result.T_match_query, truth)
    assert 1e-6 < angle_deg < 0.15
    assert 1e-6 < distance < 0.015
    assert (1 - outliers) * 0.8 * result.matches < result.inliers < (1 - outliers + 0.1) * result.matches
    assert result.scale == 1.0


def test_swapped_sides_give_the_inverse(world, move):
    w, truth = world(2), move(W, T)
    a, b = w.view(np.eye(4)), w.view(truth)
    forward, backward = verify(b, a, CONFIG, 1), verify(a, b, CONFIG, 1)
    angle_deg, distance = pose_errors(np.linalg.inv(backward.T_match_query), forward.T_match_query)
    assert angle_deg < 0.1
    assert distance < 0.01


@pytest.mark.parametrize("side", ["query", "match"])
def test_landmarks_of_either_side_suffice(world, move, side):
    w, truth = world(4), move(W, T)
    match, query = w.view(np.eye(4), depth=side == "match"), w.view(truth, depth=side == "query")
    result = verify(query, match, CONFIG, 1)
    angle_deg, distance = pose_errors(result.T_match_query, truth)
    assert angle_deg < 0.15
    assert distance < 0.015


@pytest.mark.parametrize(("noise_px", "depth_noise"), [(0.3, 0.002), (1.0, 0.002), (0.5, 0.03)])
def test_covariance_is_that_of_the_errors(world, move, noise_px, depth_noise):
    """Test: 25 pairs with noise in both images and depths, which nobody tells. Expected: chi squared near 6.

    With what neighbours share and what no number of matches averages out, which are not in this world: less.
    """
    white = VerificationConfig(
        shared_share=0,
        shared_depth=0,
        rotation_systematic=0,
        translation_systematic=0,
        turn_systematic=0,
        depth_systematic=0,
        excess_share=0,
        rotation_floor_deg=1e-6,
    )
    values, cautious = [], []
    for seed in range(25):
        w, truth = world(seed, 500), move(W, T)
        match = w.view(np.eye(4), noise_px=noise_px, depth_noise=depth_noise)
        query = w.view(truth, noise_px=noise_px, depth_noise=depth_noise, depth=seed % 2 == 0)
        for config, out in ((white, values), (CONFIG, cautious)):
            result = verify(query, match, config, seed)
            E = np.linalg.inv(truth) @ result.T_match_query
            w_error = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
            e = np.concatenate([w_error, E[:3, 3]])
            out.append(e @ np.linalg.solve(result.covariance, e))
    assert 2.5 < np.mean(values) < 9.0
    assert np.percentile(values, 95) < 25
    assert 0.3 < np.mean(cautious) < np.mean(values)


def test_a_pose_that_leaves_far_matches_unexplained_is_refused(world, move):
    """Test: near things are alike in both views, what is too far for depth is elsewhere. Expected: CONTRADICTED."""
    near, far = world(20, 250, near=3, far=5), world(21, 250, near=30, far=60, low=-25, high=25)
    truth = move((0, 0.02, 0), (0.3, 0, 0.1))
    match = joined(near.view(np.eye(4), clutter=0), far.view(np.eye(4), clutter=0, depth=False))
    right = joined(near.view(truth, clutter=0), far.view(truth, clutter=0, depth=False))
    wrong = joined(near.view(truth, clutter=0), far.view(move((0, 0.3, 0), (9, 0, 0)), clutter=0, depth=False))
    result = verify(right, match, CONFIG, 1)
    assert isinstance(result, Verification)
    assert result.evidence.inliers.sum() > result.inliers + 50
    refused = verify(wrong, match, CONFIG, 1)
    assert isinstance(refused, Rejected)
    assert refused.reason == Reason.CONTRADICTED
    assert refused.inliers > 50
    assert not refused.evidence.gates[-1].passed
    assert all(gate.passed for gate in refused.evidence.gates[:-1])


def joined(a, b):
    """One view with the features of both."""
    parts = zip(vars(a.features).values(), vars(b.features).values(), strict=True)
    features = type(a.features)(*(np.concatenate(pair) for pair in parts))
    return replace(a, features=features, landmarks=np.concatenate([a.landmarks, b.landmarks]))


def test_mono_scale_is_measured(world, move):
    """Test: the match's landmarks are in units of 0.5 m, the query's of 2 m. Expected: scale 4, pose in match units."""
    w, truth = world(6), move(W, T)
    for depth_query, depth_match in ((True, True), (False, True), (True, False)):
        match = w.view(np.eye(4), depth_noise=0.01, unit=0.5, metric=False, depth=depth_match)
        query = w.view(truth, depth_noise=0.01, unit=2.0, metric=False, depth=depth_query)
        result = verify(query, match, CONFIG, 1)
        if not depth_match:
            assert isinstance(result, Rejected)
            assert result.reason == Reason.BAD_GEOMETRY
            continue
        in_match_units = truth.copy()
        in_match_units[:3, 3] /= 0.5
        angle_deg, distance = pose_errors(result.T_match_query, in_match_units)
        assert angle_deg < 0.15
        assert distance < 0.03
        if depth_query:
            assert 3.95 < result.scale < 4.05
            assert 1e-3 < result.scale_sigma < 0.02
        else:
            assert result.scale_sigma == np.inf


@pytest.mark.parametrize("calibrated", [True, False])
def test_without_depth_the_place_is_recognised_but_no_pose_claimed(world, move, ideal, calibrated):
    w = world(7)
    camera = ideal if calibrated else None
    match, query = w.view(np.eye(4), camera, depth=False), w.view(move(W, T), camera, depth=False, outliers=0.3)
    result = verify(query, match, CONFIG, 1)
    assert isinstance(result, Verification)
    assert result.T_match_query is None
    assert 0.5 * result.matches < result.inliers < 0.85 * result.matches


@pytest.mark.parametrize(("calibrated", "depth", "pairs"), [(True, True, 200), (True, False, 60), (False, False, 200)])
def test_unrelated_pairs_are_never_accepted(world, ideal, calibrated, depth, pairs):
    """Test: pairs with some 70 descriptor matches between points that have nothing to do with each other."""
    accepted = 0
    for seed in range(pairs):
        w = world(1000 + seed, 80)
        query = w.view(np.eye(4), ideal if calibrated else None, depth=depth, clutter=20)
        match = w.view(np.eye(4), ideal if calibrated else None, depth=depth, clutter=20)
        # The same descriptors at other places: shuffle points and landmarks together.
        order = w.rng.permutation(len(match.features))
        shuffled = replace(match.features, points=w.rng.uniform((0, 0), (640, 480), (len(order), 2)).astype(np.float32))
        match = replace(match, features=shuffled, landmarks=match.landmarks[order])
        result = verify(query, match, CONFIG, seed)
        assert result.matches > 20
        accepted += isinstance(result, Verification)
    assert accepted == 0


def test_crowded_inliers_are_refused(world, move):
    """Test: a small thing is seen in both views, the rest differs. Expected: no claim about the camera."""
    w = world(8, 400, low=-0.15, high=0.15, near=4, far=4.3)
    match, query = w.view(np.eye(4), clutter=300), w.view(move((0, 0, 0.1), (0.1, 0, 0)), clutter=300)
    result = verify(query, match, CONFIG, 1)
    assert isinstance(result, Rejected)
    assert result.reason == Reason.BAD_GEOMETRY
    assert result.inliers > 20


def test_few_matches_and_empty_images_are_named(world):
    w = world(9, 40)
    a, b = w.view(np.eye(4)), world(10, 40).view(np.eye(4))
    result = verify(a, b, CONFIG, 1)
    assert isinstance(result, Rejected)
    assert result.reason in (Reason.FEW_MATCHES, Reason.FEW_INLIERS)
    empty = replace(a, features=type(a.features).empty(), landmarks=np.zeros((0, 3), np.float32))
    for pair in ((a, empty), (empty, a), (empty, empty)):
        assert verify(*pair, CONFIG, 1) == Rejected(Reason.FEW_MATCHES, 0, 0)


def test_same_seed_same_bits(world, move):
    w = world(11)
    match, query = w.view(np.eye(4)), w.view(move(W, T), outliers=0.5)
    first, second = verify(query, match, CONFIG, 3), verify(query, match, CONFIG, 3)
    assert first.T_match_query.tobytes() == second.T_match_query.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_a_pose_that_few_far_points_leave_free_is_refused(world, move):
    """Test: 20 points 25 m away in the middle of the image. Expected: refused, because the pose could swing."""
    w = world(22, 20, low=-2.6, high=2.6, near=24.9, far=25.1)
    noise = {"noise_px": 1.0, "depth_noise": 0.02}
    query, match = w.view(move((0, 0.01, 0), (0.3, 0, 0)), **noise), w.view(np.eye(4), **noise)
    result = verify(query, match, CONFIG, 1)
    assert isinstance(result, Rejected)
    assert result.reason == Reason.BAD_GEOMETRY
    assert result.evidence.gates[-1].name in ("rotation_sigma_deg", "translation_sigma_per_depth")
    assert not result.evidence.gates[-1].passed
    # The same with many points near by is held.
    near = world(22, 400, low=-5, high=5, near=4, far=9)
    assert isinstance(verify(near.view(move((0, 0.01, 0), (0.3, 0, 0))), near.view(np.eye(4)), CONFIG, 1), Verification)


def test_a_pose_that_one_match_holds_is_refused(world, move):
    """Test: 25 points on a far wall, and near by one that is mistaken or, later, 40 that are right.

    The mistaken one lies where a camera that swings about the wall would see it. Expected: refused, although it fits
    and makes the pose look sure; with 40 the pose is right.
    """
    truth = move((0, 0.01, 0), (0.3, 0, 0))
    views = [
        {"T_world_cam": truth, "noise_px": 0.2, "clutter": 0, "depth": False},
        {"T_world_cam": np.eye(4), "noise_px": 0.2, "clutter": 0},
    ]
    wall = world(22, 25, low=-3.2, high=3.2, near=24.9, far=25.1)
    seen = [wall.view(**view) for view in views]
    one = world(31, 1, low=-1.5, high=-1.4, near=5, far=5.1)
    about_wall = move((0, 0, 0), (0, 0, 25)) @ move((0.03, 0.03, 0), (0, 0, 0)) @ move((0, 0, 0), (0, 0, -25))
    mistaken = {**views[0], "T_world_cam": about_wall @ truth}
    near = [one.view(**view) for view in (mistaken, views[1])]
    mistaken_fits = 0
    for seed in range(20):
        result = verify(joined(seen[0], near[0]), joined(seen[1], near[1]), CONFIG, seed)
        assert isinstance(result, Rejected)
        assert result.reason == Reason.BAD_GEOMETRY
        if result.inliers == 26:
            mistaken_fits += 1
            assert result.evidence.gate("rotation_sigma_deg").passed
            assert result.evidence.gates[-1].name == "rotation_sigma_without_one_deg"
    assert 2 <= mistaken_fits <= 15
    many = world(32, 40, low=-5, high=5, near=6, far=9)
    near = [many.view(**view) for view in views]
    result = verify(joined(seen[0], near[0]), joined(seen[1], near[1]), CONFIG, 1)
    assert isinstance(result, Verification)
    angle_deg, distance = pose_errors(result.T_match_query, truth)
    assert angle_deg < 0.1
    assert distance < 0.02


def test_what_is_left_without_one_match_is_what_the_others_say(world, move, ideal):
    """Test: leave out each match in turn and invert anew. Expected: the worst deviations are those of the system."""
    w, truth = world(33, 60), move(W, T)
    query, match = w.view(truth, depth_noise=0.01), w.view(np.eye(4), depth_noise=0.01)
    found = match_features(query.features, match.features, 0.85)
    seen = Observations(
        query.landmarks[found.query].astype(float),
        match.landmarks[found.match].astype(float),
        query.features.points[found.query].astype(float),
        match.features.points[found.match].astype(float),
        ideal,
        ideal,
    )
    system = linearise(truth, seen, errors(truth, seen) < 3, 0.003, CONFIG)
    left = system.without_one(np.array([1, 1, 1, 5, 5, 5.0]))
    each = []
    for number in np.unique(system.owners):
        J = system.J[system.owners != number]
        each.append(np.linalg.inv(J.T @ J) * system.variance_scale)
    assert len(each) > 20
    expected = worst_deviations(np.stack(each))
    assert worst_deviations(left) == pytest.approx(expected, rel=1e-6)
    everything = worst_deviations(np.linalg.inv(system.J.T @ system.J)[None] * system.variance_scale)
    assert expected[0] > 1.01 * everything[0]


def test_repeated_ground_and_strange_objects_are_refused_by_what_is_missing(world, move):
    """Test: a tenth of what must be visible is there again, the rest is other things. Expected: CONTRADICTED."""
    same, there, here = world(23, 60), world(24, 900), world(25, 900)
    truth = move((0, 0.02, 0), (0.1, 0, 0.1))
    match = joined(same.view(np.eye(4), clutter=0), there.view(np.eye(4), clutter=0))
    query = joined(same.view(truth, clutter=0), here.view(truth, clutter=0))
    result = verify(query, match, CONFIG, 1)
    assert isinstance(result, Rejected)
    assert result.reason == Reason.CONTRADICTED
    assert result.evidence.gates[-1].name == "confirmed"
    assert len(result.evidence.missing) > 400
