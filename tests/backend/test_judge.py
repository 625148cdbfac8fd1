"""Which loops are believed, and when they no longer are: two laps of a circle, loops from the second to the first."""

import numpy as np
import pytest

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import odometry_chi2
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.judge import MARGIN_SHARE, PoseJudge
from seamark.backend.ledger import Finding, LoopHistory, LoopLedger
from seamark.backend.types import Reason

CONFIG = BackendConfig()
LAP = 100
EDGE = np.diag([1e-3**2] * 3 + [5e-3**2] * 3)
LOOP = np.diag([3e-3**2] * 3 + [0.03**2] * 3)


def ledger_after(keyframes=2 * LAP):
    """A ledger that knows the odometry of two laps of 63 m."""
    angles = 2 * np.pi * np.arange(keyframes) / LAP
    truth = np.tile(np.eye(4), (keyframes, 1, 1))
    truth[:, 0, 0] = truth[:, 1, 1] = np.cos(angles)
    truth[:, 1, 0], truth[:, 0, 1] = np.sin(angles), -np.sin(angles)
    truth[:, 0, 3], truth[:, 1, 3] = 10 * np.sin(angles), -10 * np.cos(angles)
    chains = OdometryChains(CONFIG.drift)
    chains.extend([Node(k, 0, k - 1 if k else None, truth[k], EDGE) for k in range(keyframes)])
    return LoopLedger(PoseJudge(chains, CONFIG.consistency)), truth, chains


def finding(truth, q, m, rng, offset=0.0, inliers=20):
    """A loop that takes the place for one ``offset`` metres off along the world's y axis."""
    elsewhere = np.eye(4)
    elsewhere[1, 3] = offset
    T = np.linalg.inv(truth[m]) @ elsewhere @ truth[q]
    T[:3, 3] += rng.normal(0, 0.02, 3)
    return Finding(q, m, 0, 0, inliers, Constraint(q, m, T, LOOP))


def test_a_lone_loop_waits_for_a_second_and_both_count_then():
    ledger, truth, _ = ledger_after()
    rng = np.random.default_rng(0)
    assert ledger.add(finding(truth, 120, 20, rng)) == {(120, 20): Reason.UNCONFIRMED}
    # The same view against a neighbour of its match is no second witness; another view of the place is.
    assert ledger.add(finding(truth, 120, 22, rng))[120, 22] == Reason.UNCONFIRMED
    changed = ledger.add(finding(truth, 123, 23, rng))
    assert changed == dict.fromkeys([(120, 20), (120, 22), (123, 23)], Reason.ACCEPTED)
    assert ledger.history((120, 20)) == LoopHistory(Reason.ACCEPTED, added_at=123)


def test_a_lone_loop_with_many_inliers_or_a_tight_cycle_needs_no_second():
    ledger, truth, _ = ledger_after()
    rng = np.random.default_rng(0)
    assert ledger.add(finding(truth, 120, 20, rng, inliers=60)) == {(120, 20): Reason.ACCEPTED}
    # Between accepted loops the way is known so well that a wrong loop would hardly pass.
    ledger.add(finding(truth, 145, 45, rng, inliers=60))
    assert ledger.add(finding(truth, 132, 32, rng)) == {(132, 32): Reason.ACCEPTED}
    assert ledger.add(finding(truth, 134, 34, rng, offset=1.5)) == {(134, 34): Reason.INCONSISTENT}


def test_the_chance_of_a_lone_loop_is_how_often_wrong_ones_pass():
    """Test: 6000 poses drawn over the map in any direction, in the plane. Expected: the chance is their share."""
    _, truth, chains = ledger_after()
    judge, rng = PoseJudge(chains, CONFIG.consistency, planar=True), np.random.default_rng(7)
    covariance = np.diag([1e-3, 1e-3, 0.15**2, 0.5**2, 0.5**2, 1e-3])
    claimed = judge.lone_chance(Constraint(150, 50, np.linalg.inv(truth[50]) @ truth[150], covariance))
    closed = 0
    for x, y, angle in rng.uniform((-10, -10, -np.pi), (10, 10, np.pi), (6000, 3)):
        G = np.eye(4)
        G[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        G[:2, 3] = truth[150, :2, 3] + (x, y)
        closed += judge.lone_chance(Constraint(150, 50, np.linalg.inv(truth[50]) @ G, covariance)) is not None
    assert 40 < closed < 2000
    assert 0.7 * closed / 6000 < claimed < 1.4 * closed / 6000


def test_a_false_group_that_came_first_falls_soon_after_it_is_contradicted():
    """Test: five loops 1.5 m off, which odometry allows, then true ones. Expected: withdrawn within 20 keyframes."""
    ledger, truth, chains = ledger_after()
    rng = np.random.default_rng(1)
    false = [finding(truth, 100 + k, k, rng, offset=1.5) for k in range(5)]
    assert (odometry_chi2([x.constraint for x in false], chains) < CONFIG.consistency.gate_chi2).all()
    for loop in false:
        ledger.add(loop)
    assert all(ledger.history(loop.key).verdict == Reason.ACCEPTED for loop in false)
    for q in range(106, 160):
        ledger.add(finding(truth, q, q - LAP, rng))
    for loop in false:
        history = ledger.history(loop.key)
        assert history.verdict == Reason.INCONSISTENT and history.withdrawals == 1
        assert history.added_at < 106 <= history.withdrawn_at <= 126
    assert all(ledger.history((q, q - LAP)).verdict == Reason.ACCEPTED for q in range(106, 160))


def test_restored_at_once_or_one_by_one_is_the_same():
    """Test: accepted loops of two places, some of them wrong, restored both ways. Expected: the same verdicts later."""
    rng = np.random.default_rng(4)
    (at_once, truth, _), (one_by_one, _, _) = ledger_after(), ledger_after()
    old = [finding(truth, q, q - LAP, rng, offset=0.8 * (q % 7 == 0)) for q in (*range(101, 140, 2), *range(150, 170))]
    at_once.restore(old)
    for loop in old:
        one_by_one.restore([loop])
    later = [finding(truth, q, q - LAP, rng, offset=1.5 * (q % 5 == 0)) for q in range(140, 200) if not 150 <= q < 170]
    changes = [[ledger.add(loop) for loop in later] for ledger in (at_once, one_by_one)]
    assert changes[0] == changes[1] and any(len(changed) > 1 for changed in changes[0])
    for loop in (*old, *later):
        assert at_once.history(loop.key) == one_by_one.history(loop.key)


def test_true_loops_withstand_a_false_group_that_comes_later():
    ledger, truth, _ = ledger_after()
    rng = np.random.default_rng(2)
    for q in range(100, 150):
        ledger.add(finding(truth, q, q - LAP, rng))
    for q in range(150, 156):
        ledger.add(finding(truth, q, q - LAP, rng, offset=1.5))
    assert all(ledger.history((q, q - LAP)) == LoopHistory(Reason.ACCEPTED, max(q, 101)) for q in range(100, 150))
    assert all(ledger.history((q, q - LAP)).verdict == Reason.INCONSISTENT for q in range(150, 156))


def test_all_at_once_gives_what_one_by_one_gives():
    rng = np.random.default_rng(3)
    verdicts = []
    for at_once in (False, True):
        ledger, truth, _ = ledger_after()
        rng = np.random.default_rng(3)
        loops = [finding(truth, q, q - LAP, rng, offset=1.5 if q < 106 else 0.0) for q in range(100, 170, 2)]
        for batch in [loops] if at_once else [[loop] for loop in loops]:
            ledger.add_all(batch)
        verdicts.append([ledger.history(loop.key).verdict for loop in loops])
    assert verdicts[0] == verdicts[1] and Reason.INCONSISTENT in verdicts[0] and Reason.ACCEPTED in verdicts[0]


@pytest.mark.parametrize("offset", [0.0, 1.5])
def test_a_short_group_on_the_margin_of_odometry_waits_where_other_groups_were_refuted(offset):
    """Test: a group alone, then two that refute each other elsewhere. Expected: it stays only if odometry is close."""
    ledger, truth, chains = ledger_after()
    rng = np.random.default_rng(4)
    short = [finding(truth, 100 + k, k, rng, offset) for k in range(5)]
    for loop in short:
        ledger.add(loop)
    strain = odometry_chi2([loop.constraint for loop in short], chains) / CONFIG.consistency.gate_chi2
    assert all(ledger.history(loop.key).verdict == Reason.ACCEPTED for loop in short)
    for q in range(160, 165):
        ledger.add(finding(truth, q, q - LAP, rng, offset=1.2))
    for q in range(160, 165):
        ledger.add(finding(truth, q, q - LAP + 1, rng, offset=-1.2))
    stays = strain[2] <= MARGIN_SHARE
    assert stays == (offset == 0.0)
    for loop in short:
        history = ledger.history(loop.key)
        assert history.verdict == (Reason.ACCEPTED if stays else Reason.UNCONFIRMED)
        assert history.withdrawals == (0 if stays else 1)
