"""What a map says of its loops, and the command that shows it."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapError
from seamark.backend.explain import Source, explain, parse_loop_id
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot, Reason
from seamark.backend.verify import pair_seed, verify
from seamark.service.cli import app

CONFIG = BackendConfig()


@pytest.fixture
def mapped(world, move, tmp_path):
    """A map of three keyframes: 1 sees 0 again, its poses contradict the loop by 0.1 m; 2 was compared in vain."""
    w, truth = world(1), move((0, 0.05, 0), (0.2, 0, 0))
    _, jpeg = cv2.imencode(".jpg", np.full((480, 640, 3), 127, np.uint8))
    views = [w.view(np.eye(4), id=0), w.view(truth, id=1, previous_id=0, outliers=0.3)]
    views.append(world(2).view(np.eye(4), id=2, previous_id=1))
    views = [replace(k, T_odom_cam=np.eye(4), covariance=np.eye(6), jpeg=jpeg.tobytes()) for k in views]
    loops = []
    for query, accepted, reason in ((1, True, Reason.ACCEPTED), (2, False, Reason.FEW_MATCHES)):
        result = verify(views[query], views[0], CONFIG.verification, pair_seed(0, query, 0))
        T = getattr(result, "T_match_query", None)
        C = getattr(result, "covariance", None)
        loops.append(Loop(query, 0, accepted, reason, result.inliers, 0.5, 0.4, 0.1, T, C, evidence=result.evidence))
    path = tmp_path / "map.seamark"
    moved = loops[0].T_match_query @ move((0, 0, 0), (0.1, 0, 0))
    with MapStore(path) as store:
        for keyframe in views:
            store.add_keyframe(keyframe)
        store.add_loops([replace(loops[0], accepted=False, reason=Reason.UNCONFIRMED), loops[1]])
        store.add_loops([replace(loops[0], evidence=None)])
        poses = np.stack([np.eye(4), moved, np.eye(4)])
        store.update_poses(MapSnapshot(4, np.arange(3), np.zeros(3, int), np.zeros(3, int), poses, np.ones(3), ()))
    return path, loops


def test_a_loop_is_explained_with_its_weight_and_history(mapped):
    path, loops = mapped
    with MapStore(path, read_only=True) as store:
        found = explain(store, store.load_loops()[0], CONFIG, 0)
    assert found.source == Source.STORED
    assert found.evidence.gates == loops[0].evidence.gates
    assert [entry.reason for entry in found.history] == [Reason.UNCONFIRMED, Reason.ACCEPTED]
    np.testing.assert_allclose(found.error, [0, 0, 0, 0.1, 0, 0], atol=1e-9)
    expected = 0.01 * np.linalg.inv(loops[0].covariance)[3, 3]
    assert found.chi2 == pytest.approx(expected, rel=1e-6)
    assert found.weight == pytest.approx(1 / (1 + expected / CONFIG.graph.cauchy_width**2))
    assert 0 < found.weight < 0.2


def test_evidence_that_was_not_kept_is_worked_out_again(mapped):
    """Test: a map without evidence (an old one), then one without features. Expected: the same, then lost."""
    path, loops = mapped
    with MapStore(path) as store:
        with store.file.writing() as database:
            database.execute("DELETE FROM evidence")
        found = explain(store, store.load_loops()[0], CONFIG, 0)
        assert found.source == Source.RECOMPUTED
        np.testing.assert_array_equal(found.evidence.inliers, loops[0].evidence.inliers)
        assert found.evidence.gates == loops[0].evidence.gates
        with store.file.writing() as database:  # as earlier versions forgot
            for table in ("images", "landmarks", "features"):
                database.executemany(f"DELETE FROM {table} WHERE keyframe_id = ?", [(number,) for number in [0]])
        found = explain(store, store.load_loops()[0], CONFIG, 0)
        assert (found.source, found.evidence) == (Source.LOST, None)


def test_loops_are_named_by_their_keyframes(mapped):
    path, _ = mapped
    with MapStore(path, read_only=True) as store:
        loops = store.load_loops()
    assert parse_loop_id("1-0", loops) is loops[0]
    assert parse_loop_id("2", loops) is loops[1]
    for wrong in ("0-1", "7", "", "x", "1-0-0"):
        with pytest.raises(MapError, match="no loop"):
            parse_loop_id(wrong, loops)
    with pytest.raises(MapError, match="name one"):
        parse_loop_id("1", (*loops, replace(loops[0], match_id=3)))


def test_the_command_lists_explains_and_draws(mapped, tmp_path):
    path, loops = mapped
    runner = CliRunner()
    listed = json.loads(runner.invoke(app, ["map", "loops", str(path), "--json"]).output)
    assert [(row["id"], row["accepted"], row["reason"]) for row in listed] == [("1-0", True, "accepted")]
    listed = json.loads(runner.invoke(app, ["map", "loops", str(path), "--all", "--json"]).output)
    assert [row["id"] for row in listed] == ["1-0", "2-0"]
    out = tmp_path / "loop.png"
    arguments = ["map", "loops", str(path), "--explain", "1-0", "--out", str(out), "--json"]
    shown = json.loads(runner.invoke(app, arguments).output)
    assert shown["query"]["keyframe"] == 1
    assert sum(match[4] for match in shown["matches"]) == loops[0].evidence.inliers.sum() >= shown["inliers"] > 100
    assert all(gate["passed"] for gate in shown["gates"])
    assert [entry["reason"] for entry in shown["history"]] == ["unconfirmed", "accepted"]
    picture = cv2.imread(str(out))
    assert min(picture.shape[:2]) > 600
    green = (picture[..., 1].astype(int) > picture[..., 0] + 30) & (picture[..., 1].astype(int) > picture[..., 2] + 30)
    red = (picture[..., 2].astype(int) > picture[..., 0] + 30) & (picture[..., 2].astype(int) > picture[..., 1] + 30)
    assert min(green.sum(), red.sum()) > 1000
    text = runner.invoke(app, ["map", "loops", str(path), "--explain", "2"]).output
    assert "refused: few_matches" in text
    assert "failed" in text
