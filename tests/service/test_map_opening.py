"""Maps that a run or a service goes on with: the words they were quantised with, copies, and counting on."""

import logging
from pathlib import Path

import numpy as np
import pytest

from seamark.backend.errors import MapError
from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore
from seamark.datasets_synth.toy import toy_sequence
from seamark.frontend.types import Mode
from seamark.service.config import load_config
from seamark.service.nodes.map_opening import open_map
from seamark.service.nodes.settings import NodeSettings
from seamark.service.run import RunOptions, run
from seamark.vocab.vocabulary import Vocabulary

SEED = 5


def words(path: Path, seed: int) -> Path:
    rng = np.random.default_rng(seed)
    Vocabulary(rng.integers(0, 256, (64, 128)).astype(np.uint8), np.ones(64, np.float32)).save(path)
    return path


def test_a_map_knows_its_vocabulary_and_says_when_it_is_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one, other = words(tmp_path / "one", 1), words(tmp_path / "other", 2)
    path = tmp_path / "map.seamark"
    hashes = [Vocabulary.load(vocabulary).hash for vocabulary in (one, other)]
    for vocabulary, made, warnings in ((one, 0, 0), (one, 0, 0), (other, 1, 1), (other, 1, 1), (one, 0, 2)):
        with caplog.at_level(logging.WARNING):
            store = open_map(NodeSettings(Mode.RGBD, map_path=path, vocabulary=vocabulary))
        assert store is not None
        assert store.meta()["vocabulary"] == hashes[made]
        store.close()
        assert sum("was quantised with" in record.message for record in caplog.records) == warnings
    with caplog.at_level(logging.WARNING):
        store = open_map(NodeSettings(Mode.RGBD, map_path=path, vocabulary=other, localise_only=True))
    assert store is not None and store.meta()["vocabulary"] == hashes[0]  # only a writer writes it down
    store.close()
    assert f"{hashes[0][:16]}; its places are with {hashes[1][:16]}" in caplog.records[-1].message
    with pytest.raises(MapError, match="was made in mode rgbd"):
        open_map(NodeSettings(Mode.MONO, map_path=path, vocabulary=one))


def test_a_run_goes_on_with_a_copy_of_a_map(tmp_path: Path) -> None:
    """Test: the same loop twice, the second time in the map of the first. Expected: sessions joined, ids counted on."""
    config = load_config(overrides=["frontend.keyframe_parallax_px=8", "service.record=false"])
    first = run(
        toy_sequence("loop", 30, SEED, Mode.RGBD), RunOptions(tmp_path / "a", ("toy",), in_process=True), config
    )
    path = tmp_path / "a" / "map.seamark"
    before = path.read_bytes()
    options = RunOptions(tmp_path / "b", ("toy",), in_process=True, map_path=path)
    second = run(toy_sequence("loop", 30, SEED, Mode.RGBD), options, config)
    assert path.read_bytes() == before
    old, new = (record.snapshot for record in (first, second))
    ids = new.keyframe_ids.tolist()
    assert ids[: len(old.keyframe_ids)] == old.keyframe_ids.tolist() and len(ids) > len(old.keyframe_ids)
    assert set(new.sessions.tolist()) == {0, 1} and set(new.components.tolist()) == {0}
    fresh = [loop for loop in new.loops if loop.accepted and loop.query_id > max(old.keyframe_ids)]
    assert any(loop.match_id <= max(old.keyframe_ids) for loop in fresh)
    # The second session saw the same frames: it lies where the first lay.
    apart = [
        np.linalg.norm(new.T_map_cam[ids.index(loop.query_id), :3, 3] - new.T_map_cam[ids.index(loop.match_id), :3, 3])
        for loop in fresh
        if loop.T_match_query is not None and np.linalg.norm(loop.T_match_query[:3, 3]) < 0.02
    ]
    assert apart and max(apart) < 0.1
    assert check_map(tmp_path / "b" / "map.seamark").problems == ()
    with MapStore(tmp_path / "b" / "map.seamark", read_only=True) as store:
        assert [session.id for session in store.load_sessions()] == [0, 1]
