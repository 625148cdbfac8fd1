"""Node processes come alive, are replaced when they die, say why they cannot start, and stop in order."""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from seamark.frontend.types import Frame, Mode
from seamark.service import launcher as launcher_module
from seamark.service import node_process
from seamark.service.bus import BusError, UnavailableError
from seamark.service.launcher import LOST_KEYFRAMES, Launcher, NodeFailedError, StartInterruptedError
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Empty
from seamark.service.topics import BACKEND, FRAME, FRONTEND, NODES, STATUS, VOCAB

pytestmark = pytest.mark.zenoh
SCRIPT = str(Path(__file__).with_name("fake_node.py"))
PATIENCE_S = 60.0


def launch(path: Path, behaviour: str = "well", max_restarts: int = 3) -> Launcher:
    settings = NodeSettings(Mode.RGBD, map_path=path / "stopped.txt", namespace="launcher")
    commands = {name: (sys.executable, SCRIPT, name, behaviour) for name in NODES}
    return Launcher(settings, commands=commands, max_restarts=max_restarts)


def frame(index: int) -> Frame:
    return Frame(index, 0, np.zeros((2, 2), np.uint8), file=f"a/{index}")


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def gone(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return True
    return False


def test_nodes_answer_and_stop_in_order(tmp_path: Path) -> None:
    with launch(tmp_path) as launcher:
        for node in NODES:
            status = launcher.bus.request(STATUS[node], Empty(), PATIENCE_S)
            assert status.node == node and status.pid == launcher.process_id(node)
            assert status.counters["threads"] == 1
        assert launcher.bus.request(FRAME, frame(3), PATIENCE_S).file == "3"
        pids = [launcher.process_id(node) for node in NODES]
    assert (tmp_path / "stopped.txt").read_text(encoding="utf-8").split() == [FRONTEND, VOCAB, BACKEND]
    assert all(gone(pid) for pid in pids)
    usage = launcher.stop()
    assert [one.name for one in usage] == list(NODES)
    assert all(20e6 < one.peak_rss_bytes < 2e9 and 0.01 < one.cpu_s < 60 for one in usage)
    with pytest.raises(NodeFailedError):
        _ = launcher.bus


def test_a_killed_node_is_replaced_and_goes_on_counting(tmp_path: Path) -> None:
    with launch(tmp_path) as launcher:
        with pytest.raises(UnavailableError):
            launcher.bus.request(FRAME, frame(13), PATIENCE_S)  # kills the front end
        wait_until(lambda: launcher.restarts[FRONTEND] == 1)

        def answers() -> bool:
            try:
                return bool(launcher.bus.request(STATUS[FRONTEND], Empty()).counters["first"] == 7 + LOST_KEYFRAMES)
            except BusError:
                return False

        wait_until(answers)
        assert launcher.bus.request(FRAME, frame(14), PATIENCE_S).index == 14
        launcher.check()
    assert len((tmp_path / "stopped.txt").read_text(encoding="utf-8").split()) == 3


def test_a_node_that_dies_too_often_is_given_up(tmp_path: Path) -> None:
    with launch(tmp_path, max_restarts=0) as launcher:
        os.kill(launcher.process_id(VOCAB), signal.SIGKILL)

        def failed() -> bool:
            try:
                launcher.check()
            except NodeFailedError as error:
                assert "the vocab node has ended: exit code -9" in str(error)
                return True
            return False

        wait_until(failed)


def test_a_node_that_cannot_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(NodeFailedError, match=r"the vocab node has ended: the vocabulary words\.npz is damaged"):
        launch(tmp_path, "ill").__enter__()


def test_a_start_that_takes_long_can_be_given_up(tmp_path: Path) -> None:
    """Test: the vocabulary describes a large map, and the service is told to stop. Expected: gone soon, unforced."""
    launcher: Launcher | None = None
    pids: list[int] = []

    def interrupted() -> bool:
        assert launcher is not None
        pids.append(launcher.process_id(VOCAB))
        return len(pids) > 5  # its interpreter has come far enough to read the settings, or waits for them

    settings = NodeSettings(Mode.RGBD, map_path=tmp_path / "stopped.txt", namespace="launcher")
    commands = {name: (sys.executable, SCRIPT, name, "slow") for name in NODES}
    launcher = Launcher(settings, commands=commands, interrupted=interrupted)
    began = time.monotonic()
    with pytest.raises(StartInterruptedError):
        launcher.__enter__()
    assert time.monotonic() - began < launcher_module.STOP_TIMEOUT_S + 2
    assert len(set(pids)) == 1 and gone(pids[0])
    assert all(one.peak_rss_bytes for one in launcher.stop()) and launcher.restarts == dict.fromkeys(NODES, 0)


def test_crashes_far_apart_are_none_too_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test: a node crashes once in each period in which it may once. Expected: it is started again each time."""
    monkeypatch.setattr(launcher_module, "RESTARTS_WITHIN_S", 0.0)
    with launch(tmp_path, max_restarts=1) as launcher:
        for count in (1, 2, 3):
            os.kill(launcher.process_id(VOCAB), signal.SIGKILL)
            wait_until(lambda count=count: launcher.restarts[VOCAB] == count)  # type: ignore[misc]
            launcher.wait_until_alive()
        launcher.check()


def test_a_node_that_cannot_be_started_again_ends_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test: a node crashes when the system has no room for another process. Expected: the service says so."""

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    with launch(tmp_path) as launcher:
        monkeypatch.setattr(node_process.subprocess, "Popen", refused)
        os.kill(launcher.process_id(VOCAB), signal.SIGKILL)
        with pytest.raises(NodeFailedError, match=r"the vocab node has ended.*cannot be started again"):
            wait_until(lambda: launcher.check())  # type: ignore[func-returns-value]


def test_a_node_that_does_not_say_how_far_it_is_ends_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Test: a front end is to be started again while the back end lives and does not answer. Expected: an end."""
    monkeypatch.setattr(launcher_module, "PROGRESS_TIMEOUT_S", 0.5)
    with launch(tmp_path, "mute") as launcher:
        os.kill(launcher.process_id(FRONTEND), signal.SIGKILL)
        with pytest.raises(
            NodeFailedError, match=r"the frontend node has ended.*the backend node lives and does not say"
        ):
            wait_until(lambda: launcher.check())  # type: ignore[func-returns-value]


def test_a_node_that_does_not_stop_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher_module, "STOP_TIMEOUT_S", 0.3)
    with launch(tmp_path, "stubborn") as launcher:
        process_id = launcher.process_id(BACKEND)
    assert gone(process_id)
    assert "backend" not in (tmp_path / "stopped.txt").read_text(encoding="utf-8")


def test_nodes_do_not_outlive_a_parent_that_was_killed(tmp_path: Path) -> None:
    code = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_launcher import launch, NODES
launcher = launch(Path({str(tmp_path)!r})).__enter__()
print(*[launcher.process_id(node) for node in NODES], flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        assert len(pids) == 3 and not any(gone(pid) for pid in pids)
        parent.kill()
    wait_until(lambda: all(gone(pid) or _is_zombie(pid) for pid in pids))


def _is_zombie(process_id: int) -> bool:
    try:
        return ") Z " in Path(f"/proc/{process_id}/stat").read_text(encoding="ascii")
    except OSError:
        return True


def test_a_front_end_counts_on_also_when_the_others_died_with_it(tmp_path: Path) -> None:
    """Test: all three killed at once. Expected: the next front end waits for the others' numbers, and repeats none."""
    with launch(tmp_path) as launcher:
        for node in NODES:
            os.kill(launcher.process_id(node), signal.SIGKILL)
        wait_until(lambda: launcher.restarts == dict.fromkeys(NODES, 1))
        launcher.wait_until_alive()
        counters = launcher.bus.request(STATUS[FRONTEND], Empty(), PATIENCE_S).counters
        assert counters["first"] == 7 + LOST_KEYFRAMES
