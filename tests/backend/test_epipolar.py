"""The pose without its length, against cameras whose poses are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.epipolar import Direction, Views, direction_of, fit_epipolar
from seamark.backend.errors import MapCorruptError
from seamark.backend.evidence import Evidence, decode_evidence, encode_evidence
from seamark.backend.verify import Verification, verify
from seamark.service.directions import describe_direction, direction_as_json

CONFIG = VerificationConfig()
WHITE = VerificationConfig(shared_share=0)


def truth_of(move, seed):
    """A way in any direction of some 0.8 m, and a turn of a few degrees."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    return move(rng.normal(0, 0.05, 3), 0.8 * way / np.linalg.norm(way))


def errors_of(found, truth):
    E = found.R_match_query.T @ truth[:3, :3]
    angle = np.arccos(np.clip((np.trace(E) - 1) / 2, -1, 1))
    cosine = found.bearing @ truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    return angle, np.arccos(np.clip(cosine, -1, 1))


@pytest.mark.parametrize("lens", ["ideal", "distorted"])
def test_rotation_and_bearing_are_right_and_as_sure_as_they_say(world, move, request, lens):
    """Test: 40 pairs without depth, a seventh of the matches wrong. Expected: errors of the size that is claimed."""
    camera = request.getfixturevalue(lens)
    rotations, bearings = [], []
    for seed in range(40):
        w, truth = world(seed, 500), truth_of(move, seed)
        match = w.view(np.eye(4), camera, depth=False)
        query = w.view(truth, camera, depth=False, outliers=0.15)
        result = verify(query, match, WHITE, seed)
        assert isinstance(result, Verification)
        assert result.T_match_query is None
        angle, aside = errors_of(result.direction, truth)
        assert np.rad2deg(angle) < 1.0
        assert np.rad2deg(aside) < 5.0
        rotations.append(angle / result.direction.rotation_sigma)
        bearings.append(aside / result.direction.bearing_sigma)
    # The deviations are those of the worst direction, the errors have two or three: near 1 or 1.5 is to be expected.
    for ratios in (rotations, bearings):
        assert 0.6 < np.median(ratios) < 1.6
        assert 1.2 < np.percentile(ratios, 90) < 3


def test_what_neighbours_share_makes_it_less_sure(world, move):
    """Test: key points off by half a pixel, each by itself or all of a cell alike. Expected: the latter tell less."""
    w, truth = world(1), truth_of(move, 1)
    match, query = w.view(np.eye(4), noise_px=0.1, depth=False), w.view(truth, noise_px=0.1, depth=False)
    points, rng = match.features.points, np.random.default_rng(1)
    cells = (points // 80).astype(int) @ (1, 8)
    alone, alike = rng.normal(0, 0.7, (len(points), 2)), rng.normal(0, 0.7, (48, 2))[cells]
    sigmas = []
    for off in (alone, alike):
        moved = replace(match.features, points=(points + off).astype(np.float32))
        said = verify(query, replace(match, features=moved), CONFIG, 1).direction
        sigmas.append((said.rotation_sigma, said.bearing_sigma))
    assert 1.3 * sigmas[0][0] < sigmas[1][0] < 10 * sigmas[0][0]
    assert 1.3 * sigmas[0][1] < sigmas[1][1] < 10 * sigmas[0][1]


def test_nothing_is_said_where_the_views_leave_it_open(world, move):
    turned = world(2).view(move((0.02, 0.1, 0.05), (0, 0, 0)), depth=False), world(2).view(np.eye(4), depth=False)
    wall = world(3, 500, low=-4, high=4, near=5.99, far=6.0)
    plane = wall.view(move((0, 0.1, 0), (0.8, 0, 0.2)), depth=False), wall.view(np.eye(4), depth=False)
    for pair in (turned, plane):
        result = verify(*pair, CONFIG, 1)
        assert isinstance(result, Verification)
        assert result.inliers > 100
        assert result.direction is None


def test_points_behind_the_cameras_say_nothing(world, move, ideal):
    """Test: pixels of a mirrored world, which fit an essential matrix with depths of both signs. Expected: None."""
    rng = np.random.default_rng(4)
    X = rng.uniform((-3, -3, 4), (3, 3, 9), (200, 3))
    X[::2] *= -1
    T = np.linalg.inv(truth_of(move, 4))
    Y = X @ T[:3, :3].T + T[:3, 3]
    pixels = [P[:, :2] / P[:, 2:] * (ideal.fx, ideal.fy) + (ideal.cx, ideal.cy) for P in (Y, X)]
    views = Views(*pixels, (ideal, ideal))
    E, inliers = fit_epipolar(views, CONFIG, 1)
    assert inliers.sum() > 150
    assert direction_of(E, views, inliers, CONFIG) is None


def test_without_calibration_or_with_depth_there_is_no_direction(world, move):
    w, truth = world(5), truth_of(move, 5)
    uncalibrated = verify(w.view(truth, None, depth=False), w.view(np.eye(4), None, depth=False), CONFIG, 1)
    assert isinstance(uncalibrated, Verification)
    assert uncalibrated.direction is None
    posed = verify(w.view(truth), w.view(np.eye(4)), CONFIG, 1)
    assert posed.T_match_query is not None
    assert posed.direction is None


def test_a_direction_survives_the_map_and_damage_is_named():
    direction = Direction(np.eye(3)[[1, 0, 2]], np.array([0.6, 0.0, 0.8]), 0.01, 0.02)
    evidence = Evidence(np.zeros((3, 4), np.float32), np.ones(3, bool), direction=direction)
    back = decode_evidence(encode_evidence(evidence)).direction
    np.testing.assert_array_equal(back.R_match_query, direction.R_match_query)
    np.testing.assert_array_equal(back.bearing, direction.bearing)
    assert (back.rotation_sigma, back.bearing_sigma) == (0.01, 0.02)
    assert decode_evidence(encode_evidence(Evidence(np.zeros((0, 4), np.float32), np.zeros(0, bool)))).direction is None
    short = Evidence(np.zeros((0, 4), np.float32), np.zeros(0, bool), direction=Direction(np.eye(2), np.ones(3), 1, 1))
    with pytest.raises(MapCorruptError, match="direction"):
        decode_evidence(encode_evidence(short))


def test_a_direction_is_told_in_degrees():
    quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    direction = Direction(quarter, np.array([0.6, 0.0, 0.8]), np.deg2rad(0.5), np.deg2rad(2.0))
    assert describe_direction(direction) == "towards 0.60 0.00 0.80 (+-2.0 deg), turned by 90.0 (+-0.5) deg"
    told = json.loads(json.dumps(direction_as_json(direction)))
    assert told["bearing"] == [0.6, 0.0, 0.8]
    assert told["rotation_sigma_deg"] == pytest.approx(0.5)
    assert told["bearing_sigma_deg"] == pytest.approx(2.0)
    assert told["R_match_query"] == quarter.tolist()
