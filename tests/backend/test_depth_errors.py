"""The warp and the noise of depths, found again in readings that were made with known ones."""

import numpy as np
import pytest

from seamark.backend.bundle_links import reweighed
from seamark.backend.depth_errors import Depths, measure, parallax_sigma
from seamark.frontend import se3
from seamark.frontend.camera import Camera

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
COUNT = 6000


def warp(pixels):
    """A smooth offset of inverse depth, 0.02 at most: a bowl and a slope."""
    u, v = pixels[:, 0] / 640 - 0.5, pixels[:, 1] / 480 - 0.5
    return 0.06 * (u**2 + v**2) - 0.02 * u - 0.01


def readings(noise=0.004, parallax=(0.001, 0.01), wrong=0.05, seed=1):
    """Inverse depths as a sensor gives them and as parallax does, the latter's deviations, pixels, which are wrong."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (640, 480), (COUNT, 2))
    true = rng.uniform(0.15, 0.8, COUNT)
    sigma = rng.uniform(*parallax, COUNT)
    bad = rng.random(COUNT) < wrong
    inverse = true + warp(pixels) + rng.normal(0, noise, COUNT) + np.where(bad, 0.15, 0.0)
    return inverse, true + rng.normal(0, sigma), sigma, pixels, bad, true


def measured(inverse, solved, sigma, pixels) -> Depths:
    kept, of = np.ones(len(inverse), bool), np.zeros(len(inverse), np.int64)
    return measure(inverse, solved, sigma, kept, pixels, [CAMERA], of, 1.0)


def test_the_warp_is_taken_out_and_wrong_readings_are_dropped():
    inverse, solved, sigma, pixels, bad, true = readings()
    found = measured(inverse, solved, sigma, pixels)
    left = (found.inverse - true)[~bad & np.isfinite(found.inverse)]
    assert np.abs(warp(pixels)).mean() > 0.005
    assert np.sqrt(np.mean(left**2)) < 1.2 * 0.004  # no more than the noise of a reading
    assert 0.8 * 0.004 < found.sigma < 1.3 * 0.004
    assert np.isnan(found.inverse[bad]).mean() > 0.99
    assert np.isnan(found.inverse[~bad]).mean() < 0.02
    assert found.warp == pytest.approx(np.sqrt(np.mean(warp(pixels) ** 2)) / np.median(inverse), rel=0.15)


def test_missing_readings_stay_missing_and_cameras_have_fields_of_their_own():
    inverse, solved, sigma, pixels, bad, true = readings(wrong=0.0)
    inverse[::7] = np.nan
    of = (np.arange(COUNT) % 2).astype(np.int64)
    inverse = np.where(of == 1, inverse - 2 * warp(pixels), inverse)  # the other camera errs the other way
    found = measure(inverse, solved, sigma, np.ones(COUNT, bool), pixels, [CAMERA, CAMERA], of, 1.0)
    assert np.isnan(found.inverse[::7]).all()
    left = (found.inverse - true)[np.isfinite(found.inverse)]
    assert not bad.any() and np.sqrt(np.mean(left**2)) < 1.3 * 0.004


def test_where_parallax_knows_less_depths_are_left_as_they_are():
    """Test: points that err by much more than their parallax says. Expected: not a single reading is touched."""
    inverse, solved, sigma, pixels, _, _ = readings()
    solved = solved + np.random.default_rng(3).normal(0, 0.05, COUNT)
    found = measured(inverse, solved, sigma, pixels)
    np.testing.assert_array_equal(found.inverse, inverse)
    assert found.sigma == pytest.approx(0.02 * np.median(inverse)) and found.warp == 0


def test_too_few_points_say_nothing():
    found = measured(np.array([0.5, 0.4]), np.array([0.5, np.nan]), np.full(2, 0.01), np.zeros((2, 2)))
    assert found.inverse.tolist() == [0.5, 0.4] and found.sigma == pytest.approx(0.02 * 0.45)


def test_parallax_sigma_is_what_noise_of_key_points_makes_of_a_point():
    """Test: two views 0.3 m apart and a third one ahead. Expected: the spread of triangulated depths, by simulation."""
    rng = np.random.default_rng(2)
    point, centres = np.array([0.1, 0.0, 3.0]), np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, 0.5]])
    sigma = parallax_sigma(centres, np.tile(point, (3, 1)), np.zeros(3, np.int64), 0.5, np.full(3, 500.0))
    u = [500 * (point[0] - c) / 3.0 + rng.normal(0, 0.5, 20000) for c in (0.0, 0.3)]
    simulated = np.std((u[0] - u[1]) / (500 * 0.3))
    assert sigma[0] == pytest.approx(simulated, rel=0.1)
    assert sigma[1] == pytest.approx(simulated / np.sqrt(2), rel=0.1)  # the third is aside of its ray too


@pytest.mark.parametrize(("better", "share"), [(2.0, 0.25), (1.0, 1.0), (100.0, 1 / 64)])
def test_odometry_is_trusted_as_far_as_it_is_borne_out(better, share):
    """Test: motions ``better`` times as good as they say. Expected: that share of their covariance; and what warped
    depths did to them on top, of turns by way over depth and of motions by way.
    """
    rng = np.random.default_rng(5)
    sigma = np.repeat([0.01, 0.05], 3)
    links, solved = [], {0: np.eye(4)}
    for k in range(400):
        error = np.eye(4)
        error[:3, 3] = rng.normal(0, 0.05 / better, 3)
        w = rng.normal(0, 0.01 / better, 3)
        error[:3, :3] += [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        motion = np.eye(4)
        motion[2, 3] = 0.5
        solved[k + 1] = solved[k] @ motion @ error
        solved[k + 1] = se3.orthonormalise(solved[k + 1])
        links.append((k, k + 1, motion, np.diag(sigma**2)))
    (_, _, T, C), *_ = reweighed(links, solved, 0.0, 2.0)
    np.testing.assert_array_equal(T, links[0][2])
    np.testing.assert_allclose(np.diag(C), share * sigma**2, rtol=0.2)
    bent = reweighed(links, solved, 0.1, 2.0)[0][3] - C
    np.testing.assert_allclose(np.diag(bent), np.repeat([0.025**2, 0.05**2], 3), rtol=1e-6)
