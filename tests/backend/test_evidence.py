"""Evidence of loops: gates, its way to the map and back, and what is done with damage."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from seamark.backend.config import VerificationConfig
from seamark.backend.errors import MapCorruptError
from seamark.backend.evidence import Evidence, Gate, decode_evidence, encode_evidence
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, Reason
from seamark.backend.verify import verify
from seamark.backend.visibility import look


def test_gates_know_both_directions_and_refuse_what_is_no_number():
    assert Gate("a", 5.0, 5.0).passed
    assert not Gate("a", 4.9, 5.0).passed
    assert Gate("b", 4.9, 5.0, least=False).passed
    assert not Gate("b", 5.1, 5.0, least=False).passed
    assert not Gate("c", float("nan"), 0.0).passed
    assert not Gate("c", float("nan"), 0.0, least=False).passed


def test_evidence_survives_the_map(world, move, tmp_path):
    w = world(1)
    match, query = w.view(np.eye(4), id=0), w.view(move((0, 0.05, 0), (0.2, 0, 0)), id=1, previous_id=0, outliers=0.3)
    result = verify(query, match, VerificationConfig(), 1)
    loop = Loop(1, 0, True, Reason.ACCEPTED, result.inliers, 0.5, 0.4, 0.1, evidence=result.evidence)
    with MapStore(tmp_path / "map.seamark") as store:
        for keyframe in (match, query):
            store.add_keyframe(replace(keyframe, T_odom_cam=np.eye(4), covariance=np.eye(6)))
        store.add_loops([loop])
        store.add_loops([replace(loop, accepted=False, reason=Reason.INCONSISTENT, evidence=None)])
        kept = store.evidence(1, 0)
        assert store.evidence(0, 1) is None
        assert [verdict.reason for verdict in store.history(1, 0)] == [Reason.ACCEPTED, Reason.INCONSISTENT]
    assert kept.gates == result.evidence.gates
    np.testing.assert_array_equal(kept.inliers, result.evidence.inliers)
    assert np.abs(kept.pixels - result.evidence.pixels).max() <= 1 / 16
    assert len(kept.missing) == len(result.evidence.missing) > 0
    assert kept.reprojection_px == result.evidence.reprojection_px
    assert 0 < len(encode_evidence(kept)) < 12 * len(kept.pixels) + 4 * len(kept.missing) + 1000


@pytest.mark.parametrize("matches", [0, 1, 7, 8, 9])
def test_any_number_of_matches_comes_back(matches):
    rng = np.random.default_rng(matches)
    pixels = (rng.integers(0, 8 * 5000, (matches, 4)) / 8).astype(np.float32)
    evidence = Evidence(pixels, rng.random(matches) < 0.5, (Gate("matches", matches, 15),))
    back = decode_evidence(encode_evidence(evidence))
    np.testing.assert_array_equal(back.pixels, pixels)
    np.testing.assert_array_equal(back.inliers, evidence.inliers)
    assert back.gate("matches") == evidence.gates[0]
    assert back.gate("inliers") is None
    assert np.isnan(back.reprojection_px)


@pytest.mark.parametrize(
    "blob",
    [
        b"",
        b"nothing",
        zlib.compress(b"{}\n"),
        zlib.compress(b'{"version": 99, "gates": []}\n'),
        zlib.compress(b'{"version": 1, "gates": [], "reprojection_px": 1, "matches": 3, "missing": 0}\nshort'),
        zlib.compress(b'{"version": 1, "gates": [[1]], "reprojection_px": 1, "matches": 0, "missing": 0}\n'),
        zlib.compress(b"[1, 2]\n"),
    ],
)
def test_damaged_evidence_is_named(blob):
    with pytest.raises(MapCorruptError, match="evidence"):
        decode_evidence(blob)


def test_what_a_pose_predicts_is_seen_or_missing(world, move, ideal):
    """Test: a third of the points is taken out of the query. Expected: about a third of those expected is missing."""
    w, truth = world(3), move((0, 0.03, 0), (0.1, 0, 0.1))
    match, query = w.view(np.eye(4), clutter=0), w.view(truth, clutter=0)
    gone = np.random.default_rng(1).random(len(query.features)) < 1 / 3
    f = query.features
    features = type(f)(f.points[~gone], f.scales[~gone], f.angles[~gone], f.descriptors[~gone])
    sides = (match.features, match.landmarks.astype(float), ideal)
    nothing = np.full((len(features), 3), np.nan)
    sight = look(np.linalg.inv(truth), *sides, features, nothing, ideal, 50.0)
    assert sight.expected > 200
    assert 0.6 < sight.confirmed / sight.expected < 0.72
    # Behind something near, nothing is expected.
    wall = np.tile([0.0, 0.0, 1.0], (len(features), 1))
    assert look(np.linalg.inv(truth), *sides, features, wall, ideal, 50.0).expected < 0.3 * sight.expected
    # A pose that is wrong by 20 degrees confirms next to nothing.
    wrong = look(np.linalg.inv(move((0, 0.35, 0), (0.1, 0, 0.1))), *sides, features, nothing, ideal, 50.0)
    assert wrong.confirmed < 0.05 * max(wrong.expected, 100)
