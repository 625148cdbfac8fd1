"""Reading pose graphs: what is right, what is hostile, and which edges are odometry."""

import numpy as np
import pytest

from seamark.backend.errors import GraphFileError
from seamark.backend.g2o import read_g2o
from seamark.backend.graph_parts import split_graph

INFORMATION = "100 0 0 400 0 10000"
PLANAR = f"""# three nodes and a way back
EDGE_SE2 0 1 1 0 1.5707963267948966 {INFORMATION}
EDGE_SE2 1 2 1 0 1.5707963267948966 {INFORMATION}
EDGE_SE2 2 0 1 1 3.141592653589793 {INFORMATION}
FIX 0
"""


def write(tmp_path, text):
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    return path


def test_a_planar_file_is_read_as_its_format_says(tmp_path):
    """Expected: information is x y theta, upper triangle by rows; ours is rotation first; the pose is T_from_to."""
    text = "EDGE_SE2 3 4 2 -1 0.5 100 5 3 400 7 10000\n"
    graph = read_g2o(write(tmp_path, text))
    assert graph.planar and graph.node_ids.tolist() == [3, 4]
    c, s = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(
        graph.T_from_to[0], [[c, -s, 0, 2], [s, c, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12
    )
    expected = np.linalg.inv([[100, 5, 3], [5, 400, 7], [3, 7, 10000]])
    axes = [3, 4, 2]
    np.testing.assert_allclose(graph.covariances[0][np.ix_(axes, axes)], expected, rtol=1e-9)


def test_a_spatial_file_is_read_as_its_format_says(tmp_path):
    """Expected: quaternions are x y z w, vertices give poses, the information is translation first."""
    diagonal = [1.0, 4, 16, 25, 100, 400]
    upper = [str(diagonal[i] if i == j else 0.0) for i in range(6) for j in range(i, 6)]
    half = np.sqrt(0.5)
    text = (
        "VERTEX_SE3:QUAT 7 1 2 3 0 0 0 1\nVERTEX_SE3:QUAT 9 0 0 0 0 0 1 0\n"
        f"EDGE_SE3:QUAT 7 9 1 2 3 {half} 0 0 {half} {' '.join(upper)}\n"
    )
    graph = read_g2o(write(tmp_path, text))
    assert not graph.planar
    np.testing.assert_allclose(graph.T_vertex[0][:3, 3], [1, 2, 3])
    np.testing.assert_allclose(graph.T_vertex[1][:3, :3], np.diag([-1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(graph.T_from_to[0][:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(np.diag(graph.covariances[0]), [1 / 25, 1 / 100, 1 / 400, 1, 1 / 4, 1 / 16])


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("EDGE_SE2 2 3 1 0 0 100 0 0 400", "line 6: EDGE_SE2 has 9 numbers where 11 are needed"),
        (f"EDGE_SE2 2 3 nan 0 0 {INFORMATION}", "line 6: EDGE_SE2 has a number"),
        (f"EDGE_SE2 2 3 x 0 0 {INFORMATION}", "line 6: EDGE_SE2 has a number"),
        ("EDGE_SE2 2 3 1 0 0 100 0 0 400 0 inf", "line 6: EDGE_SE2 has a number"),
        ("EDGE_SE2 2 3 1 0 0 100 0 0 -400 0 10000", "line 6: .* not positive definite"),
        ("EDGE_SE2 2 3 1 0 0 1 2 0 1 0 1", "line 6: .* not positive definite"),
        (f"EDGE_SE2 2 2 1 0 0 {INFORMATION}", "line 6: the edge joins node 2 with itself"),
        (f"EDGE_SE2 2 -3 1 0 0 {INFORMATION}", "line 6: -3 is no node"),
        (f"EDGE_SE2 2 3.5 1 0 0 {INFORMATION}", "line 6: 3.5 is no node"),
        ("VERTEX_SE2 0 0 0 0", "names node 1, which has no vertex"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "mixes planar and spatial"),
    ],
)
def test_hostile_lines_are_named(tmp_path, line, complaint):
    with pytest.raises(GraphFileError, match=complaint):
        read_g2o(write(tmp_path, PLANAR + line + "\n"))


def test_files_that_are_none(tmp_path):
    with pytest.raises(GraphFileError, match="cannot be read"):
        read_g2o(tmp_path / "missing.g2o")
    with pytest.raises(GraphFileError, match="has no EDGE"):
        read_g2o(write(tmp_path, "\0\1 garbage\nVERTEX_SE2 0 0 0 0\n"))
    with pytest.raises(GraphFileError, match="node 0 more than once"):
        read_g2o(
            write(tmp_path, "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nVERTEX_SE2 2 0 0 0\n" + PLANAR)
        )
    with pytest.raises(GraphFileError, match="quaternion"):
        upper = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
        read_g2o(write(tmp_path, f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 2 {upper}\n"))


def test_odometry_and_loops_are_told_apart(tmp_path):
    """Test: an odometry edge given backward, a repeated loop, a gap. Expected: two parts, one loop, one duplicate."""
    text = (
        f"EDGE_SE2 0 1 1 0 0.5 {INFORMATION}\nEDGE_SE2 2 1 -1 0 0 {INFORMATION}\nEDGE_SE2 4 5 1 0 0 {INFORMATION}\n"
        f"EDGE_SE2 5 0 3 0 0 {INFORMATION}\nEDGE_SE2 0 5 9 9 0 {INFORMATION}\n"
    )
    graph = read_g2o(write(tmp_path, text))
    assert graph.ignored == {}
    parts = split_graph(graph)
    # 0 1 2 | 4 5: the ids follow each other in the file's order, but nothing joins 2 with 4.
    assert [(node.id, node.session, node.previous_id) for node in parts.nodes] == [
        (0, 0, None),
        (1, 0, 0),
        (2, 0, 1),
        (4, 1, None),
        (5, 1, 4),
    ]
    c, s = np.cos(0.5), np.sin(0.5)
    np.testing.assert_allclose(parts.nodes[2].T_odom_cam[:2, 3], [1 + c, s])
    (loop,) = parts.loops
    assert (loop.query_id, loop.match_id) == (5, 0)
    np.testing.assert_allclose(loop.T_match_query[:3, 3], [-3, 0, 0], atol=1e-12)
    assert parts.ends.tolist() == [[5, 0]] and parts.duplicates.tolist() == [[0, 5]]


def test_a_covariance_goes_over_to_the_other_end(tmp_path):
    """Test: a loop written from the later node. Expected: errors sampled at the file's end have that spread at ours."""
    odometry = "EDGE_SE2 0 1 1 0 0 100 0 0 100 0 100\nEDGE_SE2 1 2 1 0 0 100 0 0 100 0 100\n"
    text = odometry + "EDGE_SE2 2 0 3 4 0.3 1e4 0 0 1e4 0 1e4\n"
    (loop,) = split_graph(read_g2o(write(tmp_path, text))).loops
    rng = np.random.default_rng(0)
    measured = np.linalg.inv(loop.T_match_query)  # T_2_0 as the file has it, whose error is in the frame of 0
    errors = []
    for x, y, turn in rng.normal(0, 0.01, (4000, 3)):
        E = np.array(
            [[np.cos(turn), -np.sin(turn), 0, x], [np.sin(turn), np.cos(turn), 0, y], [0, 0, 1, 0], [0, 0, 0, 1]]
        )
        wrong = np.linalg.inv(loop.T_match_query) @ np.linalg.inv(measured @ E)  # in the frame of 2
        errors.append([np.arctan2(wrong[1, 0], wrong[0, 0]), wrong[0, 3], wrong[1, 3]])
    axes = [2, 3, 4]
    np.testing.assert_allclose(np.cov(np.array(errors).T), loop.covariance[np.ix_(axes, axes)], atol=2e-4, rtol=0.1)
