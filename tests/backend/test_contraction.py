"""Contracted graphs: odometry is composed exactly, loops as their marginals are, poses stay near the full solution."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.contraction import MOST_AVERAGED, MOST_LOOPS, contract
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.pose_graph import PoseGraph
from seamark.frontend import se3

CONFIG = BackendConfig()
PER_LAP, RADIUS_M = 40, 6.0
SIGMA_R, SIGMA_T = 0.002, 0.01
NOISE = np.diag([SIGMA_R**2] * 3 + [SIGMA_T**2] * 3)


def jolt(rng: np.random.Generator) -> np.ndarray:
    return se3.make(se3.exp_rotation(rng.normal(0, SIGMA_R, 3)), rng.normal(0, SIGMA_T, 3))


def laps(count: int, rng: np.random.Generator, metric: bool = True) -> tuple[list[np.ndarray], list[Node]]:
    """Return the true poses of some laps, and nodes whose odometry has noise and a bias."""
    truth, nodes, pose = [], [], np.eye(4)
    for k in range(count * PER_LAP):
        angle = 2 * np.pi * k / PER_LAP
        position = [RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), 0.1 * np.sin(3 * angle)]
        truth.append(se3.make(se3.exp_rotation(np.array([0, 0, angle])), np.array(position)))
        if k:
            motion = se3.inverse(truth[-2]) @ truth[-1] @ jolt(rng)
            motion[:3, 3] *= 1.005
            pose = se3.orthonormalise(pose @ motion)
        nodes.append(Node(k, 0, k - 1 if k else None, pose, NOISE, metric))
    return truth, nodes


def loop(truth: list[np.ndarray], query: int, match: int, rng: np.random.Generator) -> Constraint:
    return Constraint(query, match, se3.inverse(truth[match]) @ truth[query] @ jolt(rng), NOISE)


def solved(nodes: list[Node], loops: list[Constraint]) -> PoseGraph:
    graph = PoseGraph(CONFIG)
    for node in nodes:
        graph.add_keyframe(node)
    for one in loops:
        graph.add_loop(one)
    graph.optimise(thorough=True)
    return graph


def error_m(graph: PoseGraph, truth: list[np.ndarray], ids: list[int]) -> float:
    """Return the RMS error of the positions of some keyframes after rigid alignment."""
    estimate = graph.optimise()
    rows = np.searchsorted(estimate.keyframe_ids, ids)
    a, b = np.array([truth[k][:3, 3] for k in ids]), estimate.T_map_cam[rows, :3, 3]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    turn = (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(((b @ turn.T - a) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("metric", [True, False])
def test_odometry_between_those_that_stay_is_what_it_was(metric: bool) -> None:
    """Test: 55 of 80 keyframes go, in three portions and in any order. Expected: the same motions and covariances."""
    rng = np.random.default_rng(1)
    _, nodes = laps(2, rng, metric)
    order = rng.permutation(79)[:55].tolist()
    left = list(nodes)
    for part in (order[:20], order[20:41], order[41:]):
        left = list(contract(left, [], part, CONFIG.drift).nodes)
    ids = [node.id for node in left]
    assert ids == sorted(set(range(80)) - set(order))
    full, short = OdometryChains(CONFIG.drift), OdometryChains(CONFIG.drift)
    full.extend(nodes)
    short.extend(left)
    pairs = [(a, b) for a in ids for b in ids[::3] if a != b]
    before, after = (chain.relative(*map(list, zip(*pairs, strict=True))) for chain in (full, short))
    np.testing.assert_allclose(after.T_a_b, before.T_a_b, atol=1e-9)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-6, atol=1e-14)
    np.testing.assert_array_equal(after.keyframes, before.keyframes)
    np.testing.assert_allclose(after.scale_variance, before.scale_variance)


def test_a_ring_without_most_of_its_keyframes_has_their_marginals() -> None:
    """Test: one lap and the loop that closes it. Expected: poses and covariances of GTSAM, for nothing is cut."""
    rng = np.random.default_rng(2)
    truth, nodes = laps(1, rng)
    closing = loop(truth, 39, 0, rng)
    gone = [k for k in range(1, 39) if k % 4]
    short = contract(nodes, [closing], gone, CONFIG.drift)
    full, small = solved(nodes, [closing]), solved(list(short.nodes), list(short.loops.values()))
    ids = [node.id for node in short.nodes]
    assert set(short.loops) == {(39, 0)} and not short.composed and short.relinked == frozenset(ids[1:])
    rows = np.searchsorted(full.optimise().keyframe_ids, ids)
    assert np.abs(full.optimise().T_map_cam[rows] - small.optimise().T_map_cam).max() < 2e-3
    ratio = small.covariances(ids[1:]) / full.covariances(ids[1:])
    diagonal = np.diagonal(ratio, axis1=1, axis2=2)
    assert diagonal.min() > 0.95 and diagonal.max() < 1.05


def test_loops_of_one_that_goes_join_its_neighbours_as_its_marginal_does() -> None:
    """Test: a star of three loops, worked out by hand: the tightest is the hub, the others come through the middle."""
    rng = np.random.default_rng(3)
    truth, _ = laps(1, rng)
    nodes = [Node(k, k, None, truth[k], np.zeros((6, 6))) for k in range(5)]
    spokes = [Constraint(4, k, se3.inverse(truth[k]) @ truth[4], (k + 1) * NOISE) for k in range(3)]
    short = contract(nodes, spokes, [4], CONFIG.drift)
    assert set(short.loops) == set(short.composed) == {(1, 0), (2, 0)}
    for (query, match), made in short.loops.items():
        np.testing.assert_allclose(made.T_match_query, se3.inverse(truth[match]) @ truth[query], atol=1e-9)
        # By sampling: both spokes err on their own.
        S = [spokes[0].T_match_query, spokes[query].T_match_query]
        errors = []
        for _ in range(4000):
            a, b = (T @ _noise(rng, scale) for T, scale in zip(S, (1, query + 1), strict=True))
            E = se3.inverse(made.T_match_query) @ a @ se3.inverse(b)
            errors.append([*se3.log_rotation(E[:3, :3]), *E[:3, 3]])
        sampled = np.cov(np.array(errors).T)
        ratio = np.linalg.eigvals(np.linalg.solve(made.covariance, sampled)).real
        assert ratio.min() > 0.8 and ratio.max() < 1.25


def _noise(rng: np.random.Generator, variance: float) -> np.ndarray:
    step = np.sqrt(variance) * np.concatenate([rng.normal(0, SIGMA_R, 3), rng.normal(0, SIGMA_T, 3)])
    return se3.make(se3.exp_rotation(step[:3]), step[3:])


def test_twelve_laps_within_a_budget_stay_as_true_as_all_of_them() -> None:
    """Test: 480 keyframes in twelve laps, never more than 130 kept. Expected: poses hardly worse than with all."""
    rng = np.random.default_rng(4)
    truth, nodes = laps(12, rng)
    left: list[Node] = []
    loops: list[Constraint] = []
    every: list[Constraint] = []
    counts: dict[tuple[int, int], int] = {}
    sizes = []
    for node in nodes:
        left.append(node)
        near = [one.id for one in left if node.id - one.id > 5 and (node.id - one.id) % PER_LAP == 0][:2]
        found = [loop(truth, node.id, match, rng) for match in near if rng.random() < 0.8]
        loops += found
        every += found
        if len(left) > 130 and node.id % 20 == 0:
            gone = [one.id for one in left if _places(left)[one.id % PER_LAP] > 2 and one.id < node.id - 20][:40]
            short = contract(left, loops, gone, CONFIG.drift, counts)
            left, loops = list(short.nodes), list(short.loops.values())
            composed = {key: made.count for key, made in short.composed.items()}
            counts = {key: count for key, count in counts.items() if key in short.loops} | composed
            sizes.append(len(loops))
    ids = [node.id for node in left]
    assert len(ids) < 150 and max(counts.values()) <= MOST_AVERAGED
    assert max(sizes[len(sizes) // 2 :]) < 1.3 * max(sizes[: len(sizes) // 2])  # bounded, however many laps
    assert max(np.bincount(np.array([one.key for one in loops]).ravel())) <= MOST_LOOPS
    full, short_m = error_m(solved(nodes, every), truth, ids), error_m(solved(left, loops), truth, ids)
    direct = [one for one in every if set(one.key) <= set(ids)]
    assert full / 2 < short_m < min(1.5 * full, error_m(solved(left, direct), truth, ids))


def _places(nodes: list[Node]) -> np.ndarray:
    return np.bincount([node.id % PER_LAP for node in nodes], minlength=PER_LAP)


def test_sessions_that_a_keyframe_joins_stay_joined_without_it() -> None:
    """Test: session 1, one keyframe, has recognised places of 0 and 2. Expected: those are joined when it has gone."""
    rng = np.random.default_rng(5)
    truth, _ = laps(1, rng)
    nodes = [Node(0, 0, None, truth[0], NOISE), Node(1, 1, None, np.eye(4), NOISE), Node(2, 2, None, np.eye(4), NOISE)]
    loops = [loop(truth, 1, 0, rng), loop(truth, 2, 1, rng)]
    short = contract(nodes, loops, [1], CONFIG.drift)
    assert set(short.loops) == {(2, 0)} and {node.id for node in short.nodes} == {0, 2}
    small = solved(list(short.nodes), list(short.loops.values())).optimise()
    np.testing.assert_allclose(small.T_map_cam[1], truth[2], atol=0.08)
    assert small.components.tolist() == [0, 0]


def test_too_many_loops_of_one_keyframe_are_thinned_to_the_tightest() -> None:
    rng = np.random.default_rng(6)
    truth, nodes = laps(1, rng)
    loops = [replace(loop(truth, 39, k, rng), covariance=(k + 1) * NOISE) for k in range(30)]
    short = contract(nodes, loops, [], CONFIG.drift)
    assert set(short.loops) == {(39, k) for k in range(MOST_LOOPS)}
    assert short.dropped == {(39, k) for k in range(MOST_LOOPS, 30)}
    apart = [replace(node, session=node.id, previous_id=None) for node in nodes]
    assert set(contract(apart, loops, [], CONFIG.drift).loops) == {one.key for one in loops}
