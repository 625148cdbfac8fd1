"""Real odometry and real false loops: KITTI 06, 70 % of the loops false, by the code of the benchmark."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.config import BackendConfig

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data" / "posegraph_kitti"

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL DATA NOT TESTED: {DATA} is missing"),
]


@pytest.mark.parametrize("name", ["false_random", "false_consistent"])
def test_false_loops_leave_kitti_06_as_the_true_ones_make_it(name):
    specification = importlib.util.spec_from_file_location("posegraph", ROOT / "benchmarks" / "backend_posegraph.py")
    benchmark = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(benchmark)
    nodes, constraints, true, truth = benchmark.load(DATA / "06", name)
    odometry = benchmark.ate(np.array([node.T_odom_cam for node in nodes]), truth)
    kept, poses = benchmark.online(nodes, constraints, BackendConfig())
    assert 3.5 < odometry < 3.6
    assert (kept & true).sum() >= 0.9 * true.sum() == 0.9 * 45
    assert (kept & ~true).sum() == 0
    assert 1.5 < benchmark.ate(poses, truth) < 2.4  # the true loops alone give 2.22
