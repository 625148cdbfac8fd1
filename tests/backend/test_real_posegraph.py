"""Real odometry and real false loops: KITTI 06, 70 % of the loops false, by the code of the benchmark."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data" / "posegraph_kitti"

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL DATA NOT TESTED: {DATA} is missing"),
]


@pytest.fixture(scope="module")
def benchmark():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        specification = importlib.util.spec_from_file_location(
            "posegraph", ROOT / "benchmarks" / "backend_posegraph.py"
        )
        module = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(module)
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))
    return module


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("name", ["alpha_0.30", "false_random", "false_consistent"])
def test_false_loops_leave_kitti_06_as_the_true_ones_make_it(benchmark, name, live):
    graph, truth = benchmark.files.kitti(DATA / "06", name)
    sound = benchmark.files.true_edges(graph, truth) | (graph.to_ids == graph.from_ids + 1)
    false = set(zip(graph.from_ids[~sound].tolist(), graph.to_ids[~sound].tolist(), strict=True))
    row = benchmark.ours(graph, false, truth, live)
    assert len(false) == 99
    assert 0.9 * 45 <= row["true"] <= 45 and row["false"] == 0
    assert 1.5 < row["ate"] < 1.05 * 2.22  # the true loops alone give 2.22


@pytest.mark.parametrize("kind", ["groups", "identity", "lone"])
def test_other_false_loops_do_no_better(benchmark, kind):
    """Test: false loops of a seed and of kinds that are in no file, on hills. Expected: none of them is kept."""
    plane, flat = benchmark.files.kitti(DATA / "06", "alpha_0.30")
    spatial, truth = benchmark.files.lifted(plane, flat, benchmark.np.random.default_rng(7))
    graph, false = benchmark.files.with_false_loops(spatial, truth, kind, seed=11)
    alone = benchmark.ours(benchmark.without(graph, false), set(), truth, live=False)
    row = benchmark.ours(graph, false, truth, live=False)
    assert len(false) >= 20 and row["false"] == 0
    assert row["true"] >= 0.9 * 45
    assert 1.5 < row["ate"] < 1.05 * alone["ate"]
