"""The whole service under load, any of its processes killed with -9: the short form of benchmarks/service_kill.py."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "service_kill.py"
KILLS = 6


@pytest.mark.zenoh
def test_a_service_killed_at_random_loses_nothing_acknowledged(tmp_path: Path) -> None:
    """Test: six kills, at least one of the launcher. Expected: as above, no zombies, nobody left, stopped in time."""
    command = [sys.executable, str(SCRIPT), "--kills", str(KILLS), "--seed", "2", "--folder", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr[-2000:] + done.stdout
    report = json.loads(done.stdout)
    assert sum(report["killed"].values()) == KILLS and report["killed"]["launcher"] >= 1
    assert report["lost"] == report["lost_loops"] == []
    assert 10 < report["keyframes"] <= report["in_file"] and report["loops"] > 0
