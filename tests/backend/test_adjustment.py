"""What a full adjustment knows outlives it: pose graphs after it stay with it until something contradicts it."""

from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.adjustment import AdjustedPose, Adjustment
from seamark.backend.config import BackendConfig
from seamark.backend.contraction import contract
from seamark.backend.errors import MapError
from seamark.backend.graph_types import Constraint, Estimate, Graph, Node
from seamark.backend.map_contraction import contracted
from seamark.backend.map_info import describe_map
from seamark.backend.map_store import MapStore
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.solver import SolverProcess
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.frontend import se3

CONFIG = BackendConfig()
PER_LAP, COUNT, RADIUS_M = 30, 60, 5.0
SIGMA_R, SIGMA_T = 0.002, 0.02
NOISE = np.diag([SIGMA_R**2] * 3 + [SIGMA_T**2] * 3)
SURE = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)  # of an adjusted motion


def jolt(rng):
    return se3.make(se3.exp_rotation(rng.normal(0, SIGMA_R, 3)), rng.normal(0, SIGMA_T, 3))


def place(k):
    angle = 2 * np.pi * k / PER_LAP
    T = se3.make(se3.exp_rotation(np.array([0, 0, angle])), np.array([RADIUS_M * np.cos(angle), 0, 0]))
    T[1, 3] = RADIUS_M * np.sin(angle)
    return T


def course(count=COUNT, metric=True):
    """True poses of two laps, nodes whose odometry drifts, and a noisy loop from every third place of the second."""
    rng = np.random.default_rng(3)
    truth = np.stack([place(k) for k in range(count)])
    nodes = [Node(0, 0, None, truth[0], np.zeros((6, 6)), metric)]
    for k in range(1, count):
        motion = se3.inverse(truth[k - 1]) @ truth[k] @ jolt(rng)
        nodes.append(Node(k, 0, k - 1, se3.orthonormalise(nodes[-1].T_odom_cam @ motion), NOISE, metric))
    loops = []
    for k in range(PER_LAP, count, 3):
        loops.append(Constraint(k, k - PER_LAP, se3.inverse(truth[k - PER_LAP]) @ truth[k] @ jolt(rng), NOISE))
    return truth, nodes, loops


def adjustment(truth, loops, scale=1.0):
    poses = {k: AdjustedPose(T, scale, k - 1 if k else None, SURE if k else None) for k, T in enumerate(truth[:COUNT])}
    return Adjustment(0, poses, {loop.key: 0.5 for loop in loops})


def estimate(truth, count=COUNT, scale=1.0):
    zeros = np.zeros(count, np.int64)
    return Estimate(7, np.arange(count), zeros, np.stack(truth[:count]), np.full(count, scale))


def solver_with(truth, nodes, loops, adjustments, kind=PoseGraph):
    graph = kind(CONFIG)
    graph.restore(Graph(nodes[:COUNT], loops, estimate(truth), adjustments))
    return graph


def apart(T, truth):
    """Return the largest distance (m) of positions to the true ones, seen from the first keyframe."""
    a, b = (np.linalg.inv(poses[0]) @ poses for poses in (T, truth))
    return float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())


def raw(nodes, loops):
    graph = PoseGraph(CONFIG)
    for node in nodes:
        graph.add_keyframe(node)
    for loop in loops:
        graph.add_loop(loop)
    return graph.optimise(thorough=True).T_map_cam


@pytest.mark.parametrize("metric", [True, False])
def test_new_keyframes_and_a_loop_that_agrees_leave_it_where_it_was(metric):
    truth, nodes, loops = course(COUNT + 6, metric)
    loops = [loop for loop in loops if loop.query_id < COUNT]
    before = raw(nodes[:COUNT], loops)
    assert apart(before, truth[:COUNT]) > 0.03  # what odometry and loops alone would make of it
    graph = solver_with(truth, nodes, loops, [adjustment(truth, loops)])
    for node in nodes[COUNT:]:
        graph.add_keyframe(node)
    graph.add_loop(Constraint(COUNT + 1, 31, se3.inverse(truth[31]) @ truth[COUNT + 1], NOISE))
    for thorough in (False, True):
        result = graph.optimise(thorough)
        assert apart(result.T_map_cam[:COUNT], truth[:COUNT]) < 0.004
        np.testing.assert_allclose(result.scales[:COUNT], 1.0, atol=1e-3)


def test_later_loops_still_bend_it():
    """Test: loops over a lap that put its end 8 cm aside, where the adjustment is sure to 3 cm at best. Expected: the
    robust kernel lets them move it, by a share of what they say.
    """
    truth, nodes, _ = course()
    loose = adjustment(truth, [])
    poses = {k: replace(pose, covariance=NOISE / 4) for k, pose in loose.poses.items()}
    graph = solver_with(truth, nodes, [], [replace(loose, poses=poses)])
    aside = np.eye(4)
    aside[2, 3] = 0.08
    for k in range(30, 60):
        graph.add_loop(Constraint(k, k - 30, se3.inverse(truth[k - 30]) @ aside @ truth[k], NOISE / 4))
    result = graph.optimise(thorough=True).T_map_cam
    moved = np.mean([(se3.inverse(result[k - 30]) @ result[k])[2, 3] for k in range(30, 60)])
    assert 0.03 < moved < 0.081


def test_a_loop_that_it_rests_on_and_that_is_withdrawn_takes_it_along_and_brings_it_back():
    truth, nodes, loops = course()
    graph = solver_with(truth, nodes, loops, [adjustment(truth, loops)])
    graph.remove_loop(*loops[0].key)
    fallen = graph.optimise(thorough=True).T_map_cam
    alone = raw(nodes, loops[1:])
    np.testing.assert_allclose(np.linalg.inv(fallen[0]) @ fallen, np.linalg.inv(alone[0]) @ alone, atol=2e-3)
    assert apart(fallen, truth) > 0.03
    graph.add_loop(loops[0])
    assert apart(graph.optimise(thorough=True).T_map_cam, truth) < 0.002


def test_a_loop_that_it_does_not_rest_on_may_come_and_go():
    truth, nodes, loops = course()
    graph = solver_with(truth, nodes, loops, [adjustment(truth, loops)])
    graph.add_loop(Constraint(44, 14, se3.inverse(truth[14]) @ truth[44], NOISE))
    graph.optimise()
    graph.remove_loop(44, 14)
    assert apart(graph.optimise().T_map_cam, truth) < 0.002


def test_the_child_process_knows_it_too_and_gives_the_same_bits():
    truth, nodes, loops = course()
    results = []
    for kind in (PoseGraph, SolverProcess):
        graph = solver_with(truth, nodes, loops, [adjustment(truth, loops)], kind)
        results.append(graph.optimise(thorough=True).T_map_cam)
        graph.close()
    assert results[0].tobytes() == results[1].tobytes()


def test_contracted_it_still_holds_what_stays():
    truth, nodes, loops = course()
    whole = adjustment(truth, loops)
    gone = [k for k in range(5, COUNT - 2) if k % 4]
    change = contract(nodes, loops, gone, CONFIG.drift)
    left = whole.contracted(change)
    assert left is not None and set(left.poses) == {node.id for node in change.nodes}
    assert set(left.loops) == set(change.loops)  # of all of these the origin is one of its own
    steps = left.poses[8].previous_id
    assert steps == 4
    # Four motions, each as sure as SURE: turns add their lever arms to the sum of what each moves by.
    covariance = left.poses[8].covariance
    assert covariance is not None
    np.testing.assert_allclose(np.diag(covariance)[:3], 4e-8, rtol=1e-6)
    assert np.diag(covariance)[3:].min() > 3.99e-6
    assert np.diag(covariance)[3:].max() < 8e-6
    ids = np.array([node.id for node in change.nodes])
    poses = Estimate(8, ids, 0 * ids, truth[ids], np.ones(len(ids)))
    graph = PoseGraph(CONFIG)
    graph.exchange(Graph(change.nodes, list(change.loops.values()), poses, [left]))
    assert apart(graph.optimise(thorough=True).T_map_cam, truth[ids]) < 0.002
    assert whole.contracted(contract(nodes, loops, range(1, COUNT), CONFIG.drift)) is None


@pytest.fixture
def store(tmp_path, make_keyframe):
    """A map of 20 keyframes with two loops, and an adjustment that rests on both."""
    keyframe = make_keyframe(0)
    with MapStore(tmp_path / "map.seamark") as opened:
        for k in range(20):
            opened.add_keyframe(
                replace(
                    keyframe, id=k, session=0, previous_id=k - 1 if k else None, T_odom_cam=place(k), covariance=NOISE
                )
            )
        loops = [Loop(k, k - 10, True, Reason.ACCEPTED, 80, 0.5, 0.25, 0.125, np.eye(4), NOISE) for k in (15, 16)]
        opened.record(loops, poses_of(7), adjustments=[stored(0, range(20))])
        yield opened


def stored(number, ids):
    poses = {k: AdjustedPose(place(k), 1.5, k - 1 if k else None, SURE if k % 3 else None) for k in ids}
    return Adjustment(number, poses, {(15, 5): 0.25, (16, 6): 1.0})


def poses_of(revision):
    T = np.stack([place(k) for k in range(20)])
    T[:, 0, 3] += revision
    return MapSnapshot(revision, np.arange(20), np.zeros(20, int), np.zeros(20, int), T, np.ones(20), ())


def test_it_comes_back_from_disk_to_the_bit_and_is_replaced_as_a_whole(store: MapStore):
    (found,), made = store.load_adjustments(), stored(0, range(20))
    assert (found.id, found.loops, list(found.poses)) == (0, made.loops, list(range(20)))
    for k, pose in found.poses.items():
        assert (pose.scale, pose.previous_id) == (1.5, made.poses[k].previous_id)
        assert pose.T_map_cam.tobytes() == made.poses[k].T_map_cam.tobytes()
        assert (pose.covariance is None) == (made.poses[k].covariance is None)
    store.record(adjustments=[stored(4, range(4, 20))])
    (found,) = store.load_adjustments()
    assert found.id == 4 and min(found.poses) == 4


def test_map_info_counts_what_stands(store: MapStore):
    assert describe_map(store.path).adjusted == 20
    store.record([replace(store.load_loops()[0], accepted=False, reason=Reason.INCONSISTENT)])
    assert describe_map(store.path).adjusted == 0


def test_without_one_of_its_loops_nobody_believes_it(store: MapStore):
    with store.file.writing() as database:
        database.execute("DELETE FROM adjusted_loops WHERE query_id = 15")
    assert store.load_adjustments() == ()


def test_it_is_written_with_the_poses_or_not_at_all(store: MapStore):
    nowhere = replace(stored(0, range(20)), loops={(19, 3): 1.0})  # no loop of the map
    with pytest.raises(MapError):
        store.record(snapshot=poses_of(8), adjustments=[nowhere])
    assert store.meta()["revision"] == "7"
    assert store.load_poses()[3][0][0, 3] == pytest.approx(place(3)[0, 3] + 7)
    assert store.load_adjustments()[0].loops == {(15, 5): 0.25, (16, 6): 1.0}


def test_pruning_the_file_keeps_what_stands(store: MapStore):
    keyframes = store.load_nodes()
    nodes = [Node(k.id, k.session, k.previous_id, k.T_odom_cam, k.covariance) for k in keyframes]
    loops = {(loop.query_id, loop.match_id): loop for loop in store.load_loops()}
    constraints = [Constraint(*key, loop.T_match_query, loop.covariance) for key, loop in loops.items()]
    graph = contract(nodes, constraints, [7, 15], CONFIG.drift)
    store.contract(contracted(graph, loops, {0: 0}, store.load_adjustments()))
    (found,) = store.load_adjustments()
    assert set(found.poses) == set(range(20)) - {7, 15}
    assert found.loops.keys() == {(loop.query_id, loop.match_id) for loop in store.load_loops()}
    assert found.poses[8].previous_id == 6
    graph = contract(nodes, constraints, [8], CONFIG.drift)
    store.contract(contracted(contract(nodes[:7], [], [3], CONFIG.drift), {}, {0: 0}))  # it had fallen: it goes
    assert store.load_adjustments() == ()
