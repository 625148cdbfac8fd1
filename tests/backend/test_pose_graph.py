"""The pose graph against trajectories whose truth is known."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import consistent_matrix, gate_chi2, greedy_clique
from seamark.backend.errors import BackendInputError
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.solver import SolverProcess

CONFIG = BackendConfig()
EDGE = np.diag([1e-3**2] * 3 + [5e-3**2] * 3)
LOOP = np.diag([3e-3**2] * 3 + [0.03**2] * 3)


def exp(w, t):
    """Rotation by Rodrigues' formula in the quaternion's guise, written independently of seamark.frontend.se3."""
    T, angle = np.eye(4), float(np.linalg.norm(w))
    axis = np.asarray(w) / max(angle, 1e-12)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T[:3, :3] = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    T[:3, 3] = t
    return T


def two_laps(seed, keyframes=200, radius=10.0, bias_deg=0.03, scale_bias=0.006, first_id=0, session=0, scale_drift=0.0):
    """Walk two laps of a circle (126 m); odometry turns and stretches with a bias, as real odometry does."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 4 * np.pi, keyframes)
    truth = [exp((0, 0, a), (radius * np.cos(a), radius * np.sin(a), 0.3 * np.sin(3 * a))) for a in angles]
    odometry, nodes = [truth[0]], []
    for k in range(keyframes):
        if k:
            step = np.linalg.inv(truth[k - 1]) @ truth[k]
            noise = exp(np.deg2rad([0, 0, bias_deg]) + rng.normal(0, 1e-3, 3), rng.normal(0, 5e-3, 3))
            step[:3, 3] *= (1 + scale_bias) * np.exp(scale_drift * k)
            odometry.append(odometry[-1] @ step @ noise)
        previous = first_id + k - 1 if k else None
        nodes.append(Node(first_id + k, session, previous, odometry[k], EDGE))
    return np.array(truth), nodes


def true_loops(truth, rng, pairs, id_of=lambda k: k):
    for q, m in pairs:
        T = np.linalg.inv(truth[m]) @ truth[q] @ exp(rng.normal(0, 3e-3, 3), rng.normal(0, 0.03, 3))
        yield Constraint(id_of(q), id_of(m), T, LOOP)


def rmse(estimate, truth, align_scale=False):
    """RMSE of positions after Umeyama's alignment, written out here."""
    a, b = np.asarray(estimate)[:, :3, 3], truth[:, :3, 3]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, D, Vt = np.linalg.svd(b0.T @ a0)
    S = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    s = (D @ np.diag(S)) / (a0**2).sum() if align_scale else 1.0
    return float(np.sqrt(((b0 - s * a0 @ (U @ S @ Vt).T) ** 2).sum(1).mean()))


def lap_pairs(count=200, every=5):
    return [(q, q - count // 2) for q in range(count // 2, count, every)]


def test_honest_loops_keep_most_of_their_weight_and_wrong_ones_none():
    """Test: loops with the noise they claim beside odometry that is nearly exact, one off by 17 deviations."""
    truth, _ = two_laps(0)
    nodes = [Node(k, 0, k - 1 if k else None, T, 1e-4 * EDGE) for k, T in enumerate(truth)]
    graph = PoseGraph(CONFIG)
    graph.add_keyframes(nodes)
    loops = list(true_loops(truth, np.random.default_rng(1), [(k, k - 100) for k in range(110, 190, 2)]))
    wrong = replace(loops[0], T_match_query=loops[0].T_match_query @ exp((0, 0, 0), (0.5, 0, 0)))
    graph.add_loops([wrong, *loops[1:]])
    graph.optimise()
    weights = graph.weights()
    # 1 / (1 + 6 / 9) where errors are as long as six degrees of freedom make them, more as the poses yield to them.
    assert 0.6 < np.mean([weights[loop.key] for loop in loops[1:]]) < 0.95
    assert weights[wrong.key] < 0.05


def test_loops_remove_drift():
    """Test: loops as found one by one. Expected: the error falls to what the loops' own noise allows, not to zero."""
    truth, nodes = two_laps(1, bias_deg=0.12)
    rng = np.random.default_rng(2)
    graph = PoseGraph(CONFIG)
    loops = {loop.query_id: loop for loop in true_loops(truth, rng, lap_pairs())}
    revision = 0
    for node in nodes:
        graph.add_keyframe(node)
        if node.id in loops:
            graph.add_loop(loops[node.id])
            revision = graph.optimise().revision
    estimate = graph.optimise(thorough=True)
    before, after = rmse([node.T_odom_cam for node in nodes], truth), rmse(estimate.T_map_cam, truth)
    assert 0.5 < before < 3
    assert 0.01 < after < 0.35 * before
    assert estimate.revision == revision + 1 == len(loops) + 1
    assert estimate.keyframe_ids.tolist() == [node.id for node in nodes]
    assert set(estimate.components.tolist()) == {0}
    assert (estimate.scales == 1).all()
    np.testing.assert_allclose(estimate.T_map_cam[0], nodes[0].T_odom_cam, atol=1e-3)


def test_incremental_and_thorough_agree():
    truth, nodes = two_laps(3)
    graph = PoseGraph(CONFIG)
    for node in nodes:
        graph.add_keyframe(node)
    for loop in true_loops(truth, np.random.default_rng(4), lap_pairs()):
        graph.add_loop(loop)
        incremental = graph.optimise()
    thorough = graph.optimise(thorough=True)
    np.testing.assert_allclose(incremental.T_map_cam, thorough.T_map_cam, atol=0.02)


def test_one_true_loop_after_a_metre_of_drift_wins():
    """Test: 60 m with 1 m of drift, one loop. Expected: it passes the gate, and the ends meet as it says."""
    truth, nodes = two_laps(5, keyframes=100, radius=60 / 4 / np.pi, bias_deg=0.1, scale_bias=0.01)
    drift = np.linalg.norm(nodes[-1].T_odom_cam[:3, 3] - truth[-1][:3, 3])
    assert 0.5 < drift < 2.5
    (loop,) = true_loops(truth, np.random.default_rng(0), [(99, 0)])
    chains, graph = OdometryChains(CONFIG.drift), PoseGraph(CONFIG)
    for node in nodes:
        chains.add(node)
        graph.add_keyframe(node)
    assert gate_chi2(loop, chains) < CONFIG.consistency.gate_chi2
    graph.add_loop(loop)
    estimate = graph.optimise()
    between = np.linalg.inv(estimate.T_map_cam[0]) @ estimate.T_map_cam[99]
    assert np.linalg.norm(between[:3, 3] - loop.T_match_query[:3, 3]) < 0.1


def test_the_gate_refuses_what_odometry_cannot_explain():
    truth, nodes = two_laps(6)
    chains = OdometryChains(CONFIG.drift)
    for node in nodes:
        chains.add(node)
    (loop,) = true_loops(truth, np.random.default_rng(0), [(130, 100)])
    assert gate_chi2(loop, chains) < CONFIG.consistency.gate_chi2
    wrong = replace(loop, T_match_query=np.eye(4))  # 19 m away
    assert gate_chi2(wrong, chains) > CONFIG.consistency.gate_chi2


@pytest.mark.parametrize("kind", ["random", "group"])
def test_false_loops_do_not_bend_the_map(kind):
    """Test: 70 % of the loops false, at random or in groups that agree. Expected: error as with the true ones alone."""
    truth, nodes = two_laps(7)
    rng = np.random.default_rng(8)
    true = list(true_loops(truth, rng, lap_pairs(every=5)))
    false = []
    while len(false) < 2.4 * len(true):
        offset = exp(rng.normal(0, 0.5, 3), rng.normal(0, 5, 3))
        q, m = int(rng.integers(60, 190)), int(rng.integers(0, 40))
        for k in range(1 if kind == "random" else 6):
            # A wrong place seen for a while: offset in the match's world, moving along with the odometry.
            T = np.linalg.inv(truth[m + k]) @ truth[m] @ offset @ np.linalg.inv(truth[q]) @ truth[q + k]
            false.append(Constraint(q + k, m + k, T @ exp(rng.normal(0, 3e-3, 3), rng.normal(0, 0.03, 3)), LOOP))
    loops = [true, false]
    loops = sorted([x for part in loops for x in part], key=lambda x: x.query_id)
    chains = OdometryChains(CONFIG.drift)
    for node in nodes:
        chains.add(node)
    agree = consistent_matrix(loops, chains, CONFIG.consistency.pair_chi2)
    kept = greedy_clique(agree, np.ones(len(loops)), 20)
    chosen = [loop for loop, keep in zip(loops, kept, strict=True) if keep]
    errors = []
    for subset in (chosen, true):
        graph = PoseGraph(CONFIG)
        for node in nodes:
            graph.add_keyframe(node)
        for loop in subset:
            graph.add_loop(loop)
        errors.append(rmse(graph.optimise(thorough=True).T_map_cam, truth))
    assert sum(any(c is t for t in true) for c in chosen) >= 0.9 * len(true)
    assert sum(any(c is f for f in false) for c in chosen) <= 0.05 * len(false)
    assert errors[0] < 1.25 * errors[1]
    assert 0.01 < errors[1] < 0.5


def test_sessions_are_joined_and_fall_apart_again():
    """Test: a loop between two sessions, then its withdrawal. Expected: the older frame holds; then as before."""
    truth, first = two_laps(9)
    _, second = two_laps(10, first_id=300, session=1)
    shift = exp((0, 0, 1.0), (50, -20, 3))
    second = [replace(node, T_odom_cam=shift @ node.T_odom_cam) for node in second]
    graph = PoseGraph(CONFIG)
    for node in [*first, *second]:
        graph.add_keyframe(node)
    apart = graph.optimise()
    assert set(apart.components.tolist()) == {0, 1}
    rng = np.random.default_rng(1)
    for q in (10, 60, 110):
        T = np.linalg.inv(truth[q + 1]) @ truth[q] @ exp(rng.normal(0, 3e-3, 3), rng.normal(0, 0.03, 3))
        graph.add_loop(Constraint(300 + q, q + 1, T, LOOP))
    joined = graph.optimise()
    assert set(joined.components.tolist()) == {0}
    np.testing.assert_allclose(joined.T_map_cam[0], first[0].T_odom_cam, atol=1e-3)
    gaps = np.linalg.norm(joined.T_map_cam[:110, :3, 3] - joined.T_map_cam[200:310, :3, 3], axis=1)
    assert 0.01 < gaps.max() < 1.0
    for q in (10, 60, 110):
        graph.remove_loop(300 + q, q + 1)
    again = graph.optimise()
    assert again.components.tolist() == apart.components.tolist()
    np.testing.assert_allclose(again.T_map_cam, apart.T_map_cam, atol=1e-3)


def test_mono_scale_drift_is_closed():
    """Test: scale drifts by a factor over two laps. Expected: loops with scale bring the shape back."""
    truth, nodes = two_laps(11, scale_bias=0.0, scale_drift=0.003)
    nodes = [replace(node, metric=False) for node in nodes]
    rng = np.random.default_rng(3)
    graph = PoseGraph(CONFIG)
    for node in nodes:
        graph.add_keyframe(node)
    for q, m in lap_pairs():
        scale = np.exp(0.003 * (m - q))
        T = np.linalg.inv(truth[m]) @ truth[q] @ exp(rng.normal(0, 3e-3, 3), rng.normal(0, 0.03, 3))
        T[:3, 3] *= np.exp(0.003 * m)
        graph.add_loop(Constraint(q, m, T, LOOP, scale * np.exp(rng.normal(0, 0.01)), 0.01))
    estimate = graph.optimise(thorough=True)
    before = rmse([node.T_odom_cam for node in nodes], truth, align_scale=True)
    after = rmse(estimate.T_map_cam, truth, align_scale=True)
    assert 1.0 < before < 5
    assert 0.01 < after < 0.3 * before
    ratio = estimate.scales[199] / estimate.scales[99]
    assert 0.8 < ratio / np.exp(-0.003 * 100) < 1.25
    np.testing.assert_allclose(np.linalg.det(estimate.T_map_cam[:, :3, :3]), 1, atol=1e-9)


def test_bad_input_is_named():
    _, nodes = two_laps(12)
    graph = PoseGraph(CONFIG)
    graph.add_keyframe(nodes[0])
    spoilt = nodes[1].T_odom_cam.copy()
    spoilt[0, 3] = np.nan
    cases = [
        (lambda: graph.add_keyframe(nodes[0]), "keyframe 0 was given twice"),
        (lambda: graph.add_keyframe(nodes[5]), "keyframe 5 follows 4"),
        (lambda: graph.add_keyframe(replace(nodes[1], T_odom_cam=spoilt)), "keyframe 1 has a pose"),
        (lambda: graph.add_keyframe(replace(nodes[1], covariance=np.full((6, 6), np.inf))), "keyframe 1 has a cov"),
        (lambda: graph.add_loop(Constraint(7, 0, np.eye(4), LOOP)), "names keyframe 7"),
        (lambda: graph.add_loop(Constraint(0, 0, np.eye(4), LOOP)), "with itself"),
        (lambda: graph.add_loop(Constraint(1, 0, np.eye(4), LOOP, scale=0.0)), "scale"),
        (lambda: graph.remove_loop(1, 0), "never committed"),
    ]
    for call, text in cases:
        with pytest.raises(BackendInputError, match=text):
            call()
    assert len(graph.optimise().keyframe_ids) == 1


def test_solver_process_survives_kill_and_gives_the_same():
    """Test: kill -9 of the child, twice. Expected: poses as in-process, revisions go on, errors come through."""
    truth, nodes = two_laps(13, keyframes=60)
    graph, solver = PoseGraph(CONFIG), SolverProcess(CONFIG)
    try:
        for node in nodes:
            graph.add_keyframe(node)
            solver.add_keyframe(node)
        loops = list(true_loops(truth, np.random.default_rng(1), lap_pairs(60)))
        for k, loop in enumerate(loops):
            graph.add_loop(loop)
            solver.add_loop(loop)
            if k in (1, 4):
                os.kill(solver.pid, signal.SIGKILL)
            assert solver.optimise().revision == k + 1
        with pytest.raises(BackendInputError, match="twice"):
            solver.add_keyframe(nodes[0])
        np.testing.assert_allclose(
            solver.optimise(thorough=True).T_map_cam, graph.optimise(thorough=True).T_map_cam, atol=1e-3
        )
        assert solver.restarts == 2
    finally:
        pid = solver.pid
        solver.close()
        solver.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_child_dies_with_parent_and_gtsam_stays_out_of_it():
    """Test: kill -9 of a parent. Expected: its solver ends by itself, and GTSAM was never loaded in the parent."""
    code = (
        "import sys, time, numpy as np\n"
        "from seamark.backend.config import BackendConfig\n"
        "from seamark.backend.graph_types import Node\n"
        "from seamark.backend.slam import Slam\n"
        "from seamark.backend.solver import SolverProcess\n"
        "s = SolverProcess(BackendConfig())\n"
        "s.add_keyframe(Node(0, 0, None, np.eye(4), np.eye(6)))\n"
        "s.optimise()\n"
        "print(s.pid, 'gtsam' in sys.modules, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        pid, loaded = parent.stdout.readline().split()
        assert loaded == "False"
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        parent.stdout.close()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{pid}/stat").read_bytes().split()[2] == b"Z":
            return  # an orphan that nobody has reaped in this container
        time.sleep(0.05)
    pytest.fail("the solver outlived its parent")
