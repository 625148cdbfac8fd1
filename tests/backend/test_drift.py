"""How far odometry is trusted in the graph: as far as the loops of the map bear it out."""

import numpy as np
import pytest

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.drift import SHARES, drift_share
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.pose_graph import PoseGraph
from seamark.frontend import se3

CONFIG = BackendConfig()
LAP = 60
FINE = np.diag([np.deg2rad(0.02) ** 2] * 3 + [0.003**2] * 3)
COARSE = np.diag([np.deg2rad(0.7) ** 2] * 3 + [0.2**2] * 3)


def two_laps(bias_deg):
    """True poses (120) of two laps of 60 m, and the nodes of an odometry that turns too far by this much each time."""
    angles = 2 * np.pi * np.arange(2 * LAP) / LAP
    truth = np.array(
        [
            se3.make(se3.exp_rotation(np.array([0, a, 0])), np.array([10 * np.sin(a), 0, 10 - 10 * np.cos(a)]))
            for a in angles
        ]
    )
    turn = se3.make(se3.exp_rotation(np.array([0, np.deg2rad(bias_deg), 0])), np.zeros(3))
    T, nodes = np.eye(4), []
    for k in range(2 * LAP):
        if k:
            T = T @ se3.inverse(truth[k - 1]) @ truth[k] @ turn
        nodes.append(Node(k, 0, k - 1 if k else None, T, np.eye(6) * 1e-8))
    return truth, nodes


def loop(truth, query, match, covariance, error=None):
    T = se3.inverse(truth[match]) @ truth[query]
    return Constraint(query, match, T if error is None else T @ error, covariance)


@pytest.mark.parametrize(("bias_deg", "share"), [(0.0, SHARES[-1]), (0.15, SHARES[0])])
def test_loops_say_how_much_of_the_allowed_drift_there_is(bias_deg, share):
    """Test: an odometry without drift, and one with three times the drift that is allowed for."""
    truth, nodes = two_laps(bias_deg)
    chains = OdometryChains(CONFIG.drift)
    chains.extend(nodes)
    loops = [loop(truth, k, k - LAP, FINE) for k in (70, 80, 90, 100, 110)]
    assert drift_share(loops, chains, 10) == share
    assert drift_share([], chains, 10) == SHARES[0]


def test_many_loops_at_one_place_count_as_one():
    truth, nodes = two_laps(0.01)
    chains = OdometryChains(CONFIG.drift)
    chains.extend(nodes)
    few = drift_share([loop(truth, 71, 11, COARSE)], chains, 10)
    many = drift_share([loop(truth, k, k - LAP + d, COARSE) for k in range(70, 80) for d in (0, 1)], chains, 10)
    assert few == many > SHARES[-1]


def test_a_coarse_loop_does_not_bend_what_others_show_to_be_straight():
    """Test: good loops over a lap, and a coarse one over 12 keyframes that errs by its own deviation."""
    truth, nodes = two_laps(0.0)
    error = se3.make(se3.exp_rotation(np.array([0, np.deg2rad(0.7), 0])), np.array([0.2, 0.0, 0.0]))
    worst = {}
    for learn in (False, True):
        graph = PoseGraph(CONFIG.model_copy(update={"graph": CONFIG.graph.model_copy(update={"learn_drift": learn})}))
        for node in nodes:
            graph.add_keyframe(node)
        graph.add_loop(loop(truth, 42, 30, COARSE, error))
        for k in (70, 80, 90, 100, 110):
            graph.add_loop(loop(truth, k, k - LAP, FINE))
        estimate = graph.optimise()
        worst[learn] = np.linalg.norm(estimate.T_map_cam[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert 0.02 < worst[False] < 0.2
    assert worst[True] < 0.25 * worst[False]
