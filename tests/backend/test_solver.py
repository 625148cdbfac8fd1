"""The solver's process: it works in the background, it can be asked, and it always ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.config import BackendConfig
from seamark.backend.errors import BackendInputError, SolverError
from seamark.backend.graph_types import Constraint, Node
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.solver import SolverProcess

CONFIG = BackendConfig()
EDGE = np.diag([1e-3**2] * 3 + [5e-3**2] * 3)
LOOP = np.diag([3e-3**2] * 3 + [0.03**2] * 3)


def line(count, step=1.0):
    """Keyframes one step apart along x, without error."""
    nodes = []
    for k in range(count):
        T = np.eye(4)
        T[0, 3] = step * k
        nodes.append(Node(k, 0, k - 1 if k else None, T, EDGE))
    return nodes


def loop(q, m, offset=0.0):
    T = np.eye(4)
    T[0, 3] = q - m + offset
    return Constraint(q, m, T, LOOP)


def tell_endless_work(solver):
    """Fill a solver with a graph whose factorisation is dense: it takes far longer than any test may."""
    for node in line(1200):
        solver.add_keyframe(node)
    rng = np.random.default_rng(0)
    pairs = {(int(max(p)), int(min(p))) for p in rng.integers(0, 1200, (4000, 2)) if abs(p[0] - p[1]) > 1}
    for q, m in sorted(pairs):
        solver.add_loop(loop(q, m, rng.normal(0, 0.5)))


def gone(pid, within_s):
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        if Path(f"/proc/{pid}/stat").read_bytes().split()[2] == b"Z":
            return True  # an orphan that nobody has reaped in this container
        time.sleep(0.02)
    return False


def test_a_requested_solution_is_collected_later_and_knows_what_was_told_before():
    """Test: a request, more keyframes, a second request. Expected: first the old graph, then the whole one."""
    solver, graph = SolverProcess(CONFIG), PoseGraph(CONFIG)
    try:
        assert solver.collect(1.0) is None and solver.pid is None
        for node in line(30):
            solver.add_keyframe(node)
            graph.add_keyframe(node)
        for target in (solver, graph):
            target.add_loop(loop(25, 2, 0.5))
            target.request()
        for node in line(40)[30:]:
            solver.add_keyframe(node)
        solver.request()
        first = solver.collect(60.0)
        assert len(first.keyframe_ids) == 30 and first.revision == 1
        np.testing.assert_allclose(first.T_map_cam, graph.collect().T_map_cam, atol=1e-9)
        second = solver.collect(60.0)
        assert len(second.keyframe_ids) == 40 and second.revision == 2
        assert solver.collect(0.0) is None and graph.collect() is None
        # The ends of the loop are 23 m apart by odometry and 23.5 m by the loop: the estimate lies between.
        assert 0.01 < first.T_map_cam[25, 0, 3] - first.T_map_cam[2, 0, 3] - 23 < 0.5
    finally:
        solver.close()


def test_a_child_that_dies_while_solving_is_started_again():
    solver = SolverProcess(CONFIG)
    try:
        for node in line(20):
            solver.add_keyframe(node)
        solver.request()
        os.kill(solver.pid, signal.SIGKILL)
        estimate = None
        deadline = time.monotonic() + 60
        while estimate is None and time.monotonic() < deadline:
            estimate = solver.collect(1.0)
        assert len(estimate.keyframe_ids) == 20 and solver.restarts == 1
    finally:
        solver.close()


@pytest.mark.parametrize("in_process", [True, False])
def test_weights_and_covariances_can_be_asked_for(in_process):
    """Test: a chain of white noise. Expected: variances sum along it, a loop cuts them, a false loop weighs nothing."""
    solver = PoseGraph(CONFIG) if in_process else SolverProcess(CONFIG)
    try:
        for node in line(60):
            solver.add_keyframe(node)
        solver.optimise()
        chain = solver.covariances([0, 15, 30, 59])
        assert chain.shape == (4, 6, 6)
        along = np.sqrt(chain[:, 3, 3])
        np.testing.assert_allclose(along[2] / along[1], np.sqrt(2), rtol=0.02)
        np.testing.assert_allclose(along[3] / along[2], np.sqrt(59 / 30), rtol=0.02)
        for q, m, offset in ((50, 0, 0.0), (51, 1, 0.02), (55, 5, 40.0)):
            solver.add_loop(loop(q, m, offset))
        solver.optimise(thorough=True)
        weights = solver.weights()
        assert set(weights) == {(50, 0), (51, 1), (55, 5)}
        assert weights[50, 0] > 0.8 and weights[51, 1] > 0.5 and weights[55, 5] < 0.01
        held = solver.covariances([59])[0]
        assert np.sqrt(held[3, 3]) < 0.6 * along[3]
        assert np.linalg.eigvalsh(held)[0] > 0
        with pytest.raises(BackendInputError, match="keyframe 99"):
            solver.covariances([99])
    finally:
        solver.close()


def test_an_answer_that_is_overdue_ends_in_an_error():
    solver = SolverProcess(CONFIG, reply_timeout_s=0.3)
    try:
        tell_endless_work(solver)
        with pytest.raises(SolverError, match="died 3 times"):
            solver.optimise(thorough=True)
    finally:
        solver.close()


def test_it_closes_at_once_in_the_midst_of_solving():
    """Test: close, and SIGTERM, while the child factorises. Expected: gone at once, not when the work is done."""
    for end in ("close", "terminate"):
        solver = SolverProcess(CONFIG)
        tell_endless_work(solver)
        solver.request()
        time.sleep(2.5)  # the child has loaded GTSAM and works
        pid = solver.pid
        assert solver.collect(0.0) is None
        started = time.monotonic()
        if end == "terminate":
            os.kill(pid, signal.SIGTERM)
            assert gone(pid, 2.0)
        solver.close()
        assert time.monotonic() - started < 3.0
        assert gone(pid, 1.0)


def test_it_ends_with_a_parent_that_is_killed_in_the_midst_of_solving(tmp_path):
    code = (
        "import sys, time; sys.path.insert(0, sys.argv[1])\n"
        "from test_solver import *\n"
        "solver = SolverProcess(CONFIG)\n"
        "tell_endless_work(solver)\n"
        "solver.request()\n"
        "time.sleep(2.5)\n"
        "print(solver.pid, solver.collect(0.0) is None, flush=True)\n"
        "time.sleep(60)\n"
    )
    words = [sys.executable, "-c", code, str(Path(__file__).parent)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        pid, busy = parent.stdout.readline().split()
        parent.send_signal(signal.SIGKILL)
    assert busy == "True"
    assert gone(int(pid), 3.0)
