"""The thread that makes what keyframes carry, beside the one that tracks."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import NoDepth
from seamark.frontend.keyframes import NICENESS, KeyframeBuilder
from seamark.frontend.types import Frame, Mode


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads have no priority of their own")
def test_the_keyframe_thread_gives_way_and_no_other_does() -> None:
    """Test: a keyframe is made. Expected: one more thread, nicer than this one by NICENESS; this one is as before."""

    def niceness_of_all() -> dict[int, int]:
        threads = [int(thread.name) for thread in Path("/proc/self/task").iterdir()]
        return {thread: os.getpriority(os.PRIO_PROCESS, thread) for thread in threads}

    mine, before = os.getpriority(os.PRIO_PROCESS, 0), niceness_of_all()
    builder = KeyframeBuilder(None, Mode.PLACES, FrontendConfig(), NoDepth())
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    builder.submit([builder.request(Frame(0, 0, image), session=0)])
    builder.wait()
    new = {thread: niceness for thread, niceness in niceness_of_all().items() if thread not in before}
    assert list(new.values()).count(min(mine + NICENESS, 19)) == 1
    assert os.getpriority(os.PRIO_PROCESS, 0) == mine
    builder.close()


def test_keyframes_are_made_where_nothing_may_give_way(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refused)
    builder = KeyframeBuilder(None, Mode.PLACES, FrontendConfig(), NoDepth())
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    builder.submit([builder.request(Frame(0, 0, image), session=0)])
    builder.wait()
    assert len(builder.take()) == 1
    builder.close()
