"""What errors of matches have in common is measured, and no number of matches hides it."""

import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.shared_errors import excess_angle, independent_share, measured_share, systematic

CONFIG = VerificationConfig()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_share_of_neighbours_is_measured(share):
    """Test: 40 cells of 25 errors each with a known common part. Expected: 1.3 times that."""
    rng = np.random.default_rng(3)
    cells = np.repeat(np.arange(40), 25)
    errors = np.sqrt(share) * rng.normal(size=(40, 2))[cells] + np.sqrt(1 - share) * rng.normal(size=(1000, 2))
    found = measured_share([(errors, np.ones(1000), cells)], expected=0.1)
    assert 1.3 * share - 0.1 < found < 1.3 * share + 0.1


def test_without_neighbours_the_share_is_as_expected():
    errors = np.random.default_rng(4).normal(size=(30, 2))
    assert measured_share([(errors, np.ones(30), np.arange(30))], expected=0.1) == pytest.approx(0.13)


def test_a_mean_of_neighbours_is_as_good_as_their_news():
    """Test: 4000 draws of one cell of 30 errors that share 0.3. Expected: the mean varies as the sum of news says."""
    rng = np.random.default_rng(5)
    draws = np.sqrt(0.3) * rng.normal(size=(4000, 1)) + np.sqrt(0.7) * rng.normal(size=(4000, 30))
    news = independent_share(np.zeros(30, int), 0.3).sum()
    assert draws.mean(axis=1).var() == pytest.approx(1 / news, rel=0.1)


def test_excess_is_an_angle_only_where_neighbours_share_it():
    """Test: errors twice as large as expected. Expected: an angle; none if independent."""
    angle = excess_angle(4.0, 0.3, 500.0, CONFIG)
    assert angle == pytest.approx(2 * 0.5 * np.sqrt(2) * np.sqrt(3) / 500)
    assert excess_angle(4.0, 0.0, 500.0, CONFIG) == 0
    assert excess_angle(0.7, 0.3, 500.0, CONFIG) == 0


def test_noisy_depth_makes_long_ways_doubtful():
    """Test: 3 m ahead, depths differ by 2 per cent. Expected: 1.5 per cent; at rest the angle only."""
    T = np.eye(4)
    T[2, 3] = 3.0
    doubt = systematic(T, 5.0, 0.02, 0.0, CONFIG)
    assert 0.040 < doubt[3] < 0.050
    at_rest = systematic(np.eye(4), 5.0, 0.02, 1e-3, CONFIG)
    assert at_rest[0] == pytest.approx(1e-3, rel=0.02)
    assert at_rest[3] == pytest.approx(5e-3, rel=0.05)
