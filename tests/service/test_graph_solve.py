"""`seamark graph solve`: its files are a contract, and false loops do not bend the graph."""

import json

import numpy as np
import pytest

from seamark.backend.g2o import read_g2o
from seamark.backend.graph_solve import solve_graph
from seamark.service.cli import main

INFORMATION = "400 0 0 400 0 40000"


def circle_graph(rng, false_groups=0, laps=2, nodes=160, spatial=False):
    """Two laps of a circle in g2o text, with noise as the information says; returns text, truth and false pairs."""
    angles = np.linspace(0, 2 * np.pi * laps, nodes, endpoint=False)
    truth = np.stack([5 * np.cos(angles), 5 * np.sin(angles) + np.sin(2 * angles), angles + np.pi / 2], axis=1)

    def between(a, b):
        c, s = np.cos(a[2]), np.sin(a[2])
        d = b[:2] - a[:2]
        return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], b[2] - a[2]])

    def edge(i, j, motion):
        motion = motion + rng.normal(0, [0.05, 0.05, 0.005])
        turn = (motion[2] + np.pi) % (2 * np.pi) - np.pi
        if spatial:
            upper = " ".join(
                str(v if i == j else 0) for i, v in enumerate([400] * 3 + [40000] * 3) for j in range(i, 6)
            )
            quaternion = f"0 0 {np.sin(turn / 2):.12f} {np.cos(turn / 2):.12f}"
            return f"EDGE_SE3:QUAT {i} {j} {motion[0]:.9f} {motion[1]:.9f} 0 {quaternion} {upper}"
        return f"EDGE_SE2 {i} {j} {motion[0]:.9f} {motion[1]:.9f} {turn:.9f} {INFORMATION}"

    lines = [edge(k, k + 1, between(truth[k], truth[k + 1])) for k in range(nodes - 1)]
    lines += [edge(k, k - nodes // 2, between(truth[k], truth[k - nodes // 2])) for k in range(nodes // 2, nodes, 4)]
    false = set()
    for group in range(false_groups):
        q, m = 60 + 17 * group, 50 - 3 * group
        for k in range(6):
            false.add((m + k, q + k))
            lines.append(edge(m + k, q + k, np.array([0.1, 0.0, 0.02])))
    return "\n".join(lines) + "\n", truth, false


def run(tmp_path, monkeypatch, capsys, *words):
    monkeypatch.setattr("sys.argv", ["seamark", "graph", "solve", *map(str, words)])
    with pytest.raises(SystemExit) as stopped:
        main()
    return stopped.value.code, capsys.readouterr()


@pytest.mark.parametrize("live", [False, True])
def test_the_files_are_as_promised(tmp_path, monkeypatch, capsys, live):
    text, _, false = circle_graph(np.random.default_rng(1), false_groups=3)
    (tmp_path / "a.g2o").write_text(text)
    out = tmp_path / "out"
    extra = ["--live"] if live else []
    code, _ = run(tmp_path, monkeypatch, capsys, tmp_path / "a.g2o", "--out", out, *extra)
    assert code == 0
    assert sorted(path.name for path in out.iterdir()) == ["loops.csv", "report.json", "trajectory.tum"]
    rows = [line.split() for line in (out / "trajectory.tum").read_text().splitlines() if not line.startswith("#")]
    assert [row[0] for row in rows] == [str(k) for k in range(160)]
    assert all(len(row) == 8 and float(row[3]) == 0 for row in rows)
    table = [line.split(",") for line in (out / "loops.csv").read_text().splitlines()]
    assert table[0] == ["from", "to", "kept", "reason", "weight", "added_at", "withdrawn_at", "withdrawals"]
    assert len(table) == 1 + 20 + len(false)
    for from_id, to_id, kept, reason, weight, added_at, withdrawn_at, withdrawals in table[1:]:
        assert (kept == "1") == (reason == "accepted") == (float(weight) > 0)
        assert (int(from_id), int(to_id)) not in false or kept == "0"
        assert int(withdrawals) >= (withdrawn_at != "")
        assert kept == "0" or max(int(from_id), int(to_id)) <= int(added_at) <= 159
    report = json.loads((out / "report.json").read_text())
    assert 0 < report["solve_cpu_s"] < 60
    assert report["loops"] == 20 + len(false) and report["kept"] >= 18
    assert report["mode"] == ("live" if live else "batch") and report["planar"] is True
    assert sum(report["reasons"].values()) == report["loops"]


def test_a_file_that_is_none_gives_one_sentence(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n")
    code, printed = run(tmp_path, monkeypatch, capsys, tmp_path / "a.g2o", "--out", tmp_path / "out")
    assert code == 1 and "line 1" in printed.err and not (tmp_path / "out").exists()


def rmse(estimate, truth):
    a, b = estimate.T_map_cam[:, :2, 3], truth[:, :2]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, _, Vt = np.linalg.svd(b0.T @ a0)
    R = U @ np.diag([1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(((b0 - a0 @ R.T) ** 2).sum(1).mean()))


@pytest.mark.parametrize("spatial", [False, True])
def test_false_groups_leave_the_poses_as_true_loops_make_them(tmp_path, spatial):
    """Test: four wrong places, each seen for six nodes, beside 20 true loops. Expected: the error of the true alone."""
    errors = []
    for false_groups in (0, 4):
        text, truth, false = circle_graph(np.random.default_rng(2), false_groups, spatial=spatial)
        (tmp_path / "a.g2o").write_text(text)
        solution = solve_graph(read_g2o(tmp_path / "a.g2o"))
        assert solution.planar is not spatial
        assert not any(loop.kept for loop in solution.loops if (loop.from_id, loop.to_id) in false)
        assert sum(loop.kept for loop in solution.loops) >= 18
        errors.append(rmse(solution.estimate, truth))
    assert 0.02 < errors[0] < 0.5
    assert errors[1] < 1.05 * errors[0]


def test_parts_that_no_loop_joins_stay_apart(tmp_path):
    text, _, _ = circle_graph(np.random.default_rng(3))
    lines = [line for line in text.splitlines() if not line.startswith("EDGE_SE2 99 100 ")]
    own = [line for line in lines if int(line.split()[1]) < 100 and int(line.split()[2]) < 100]
    other = [line for line in lines if int(line.split()[1]) >= 100 and int(line.split()[2]) >= 100]
    for chosen, components in ((lines, {0}), (own + other, {0, 1})):
        (tmp_path / "a.g2o").write_text("\n".join(chosen))
        solution = solve_graph(read_g2o(tmp_path / "a.g2o"))
        assert solution.parts == 2 and len(solution.estimate.keyframe_ids) == 160
        assert set(solution.estimate.components.tolist()) == components
