"""A copy of a map, made where an earlier one was cut short."""

from pathlib import Path

import pytest

from seamark.backend.errors import MapError
from seamark.backend.map_backup import back_up_map
from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore


@pytest.mark.parametrize("leftover", [b"", b"half a page" * 500])
def test_what_a_killed_backup_left_is_in_nobodys_way(tmp_path: Path, leftover: bytes) -> None:
    path, out = tmp_path / "map.seamark", tmp_path / "copy.seamark"
    with MapStore(path):
        pass
    (tmp_path / "copy.seamark.partial").write_bytes(leftover)
    assert back_up_map(path, out) == out.stat().st_size > 0
    assert check_map(out).problems == ()
    assert {one.name for one in tmp_path.iterdir()} == {"map.seamark", "copy.seamark"}
    with pytest.raises(MapError, match="exists"):
        back_up_map(path, out)
