"""How sure a map says it is of its poses, against covariances propagated by hand."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from typer.testing import CliRunner

from seamark.backend.chain import adjoint_stack, white_covariances
from seamark.backend.config import BackendConfig
from seamark.backend.errors import MapError
from seamark.backend.graph_types import Node
from seamark.backend.map_covariances import pose_covariances
from seamark.backend.map_store import MapStore
from seamark.backend.types import MapSnapshot
from seamark.frontend import se3
from seamark.service.cli import app

CONFIG = BackendConfig()
COUNT = 8


@pytest.fixture
def path(tmp_path, make_keyframe, move):
    """A map of one session on a winding way without loops."""
    template, pose = make_keyframe(0), np.eye(4)
    with MapStore(tmp_path / "map.seamark") as store:
        poses = []
        for k in range(COUNT):
            poses.append(pose)
            previous = k - 1 if k else None
            covariance = np.diag([1e-5, 2e-5, 3e-5, 1e-4, 2e-4, 3e-4])
            own = {"id": k, "session": 0, "stamp_ns": 10 * k, "previous_id": previous}
            store.add_keyframe(replace(template, **own, T_odom_cam=pose, covariance=covariance))
            pose = pose @ move((0.1, 0.3, 0.05), (0.1, 0.2, 1.0))
        ids = np.arange(COUNT)
        snapshot = MapSnapshot(3, ids, 0 * ids, 0 * ids, np.stack(poses), np.ones(COUNT), ())
        store.record(snapshot=snapshot, meta={"mode": "rgbd", "mapped": str(COUNT - 1)})
    return tmp_path / "map.seamark"


def test_they_are_what_odometry_adds_up_to(path):
    with MapStore(path, read_only=True) as store:
        keyframes = store.load_nodes()
    expected = [1e-6 * np.eye(6)]  # the prior of the first pose
    for before, one in pairwise(keyframes):
        T = se3.inverse(before.T_odom_cam) @ one.T_odom_cam
        Ad = adjoint_stack(se3.inverse(T)[None])[0]
        node = Node(one.id, 0, before.id, one.T_odom_cam, one.covariance)
        expected.append(Ad @ expected[-1] @ Ad.T + white_covariances([node], T[None], CONFIG.drift)[0])
    found = pose_covariances(path, 5, CONFIG)
    assert found.keyframe_ids.tolist() == [3, 4, 5, 6, 7]
    assert found.stamps_ns.tolist() == [30, 40, 50, 60, 70]
    np.testing.assert_allclose(found.covariances, expected[3:], rtol=1e-3, atol=1e-9)
    sigmas = found.sigmas()
    assert sigmas[4, 0] == pytest.approx(np.rad2deg(np.sqrt(np.trace(expected[7][:3, :3]) / 3)), rel=1e-3)
    assert sigmas[4, 1] == pytest.approx(np.sqrt(np.trace(expected[7][3:, 3:]) / 3), rel=1e-3)


def test_the_command_prints_them_and_changes_nothing(path):
    content = path.read_bytes()
    printed = json.loads(CliRunner().invoke(app, ["map", "covariances", str(path), "--last", "2", "--json"]).output)
    assert [pose["keyframe"] for pose in printed["poses"]] == [6, 7]
    np.testing.assert_allclose(printed["poses"][1]["covariance"], pose_covariances(path, 1, CONFIG).covariances[0])
    assert "newest" in CliRunner().invoke(app, ["map", "covariances", str(path)]).output
    assert path.read_bytes() == content


def test_places_have_none(path):
    with MapStore(path) as store:
        store.set_meta({"mode": "places"})
    with pytest.raises(MapError, match="mode places"):
        pose_covariances(path, 3, CONFIG)
