"""Synthetic sequences by name, without a simulator: a stand-in worker speaks the protocol of the real one."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import folder, rendering, scenario, specification
from seamark.datasets_synth.rendering import NoVulkanDevice, RenderPool, require_renderer
from seamark.datasets_synth.scenario import open_synth
from seamark.frontend.types import Frame

STAND_IN = """
import json, sys
import numpy as np
from seamark.datasets_synth.sensor import code_depth, code_picture
from seamark.datasets_synth.worker import HEADER
job = json.loads(sys.stdin.readline())
if "probe_s" in job:
    print("GPU: stand-in")
    sys.exit()
for index in range(job["first"], job["specification"]["frames"], job["step"]):
    if index == DIES_AT:
        sys.exit("the driver fell over")
    left = code_picture(np.full((240, 320, 3), index % 256, np.uint8))
    depth = code_depth(np.full((240, 320), 1000 + index, np.uint16))
    sys.stdout.buffer.write(HEADER.pack(index, len(left), 0, len(depth), 0) + left + depth)
"""
SPEC = "loop,size=small,image=320x240,frames={}"


def _stand_in(monkeypatch: pytest.MonkeyPatch, dies_at: int = -1) -> None:
    code = STAND_IN.replace("DIES_AT", str(dies_at))
    monkeypatch.setattr(rendering, "COMMAND", (sys.executable, "-P", "-c", code))


def _same(a: Frame, b: Frame) -> bool:
    assert a.depth is not None and b.depth is not None
    bits = a.image.tobytes() == b.image.tobytes() and a.depth.tobytes() == b.depth.tobytes()
    return bits and (a.index, a.stamp_ns, a.file) == (b.index, b.stamp_ns, b.file) and a.depth.dtype == b.depth.dtype


@pytest.mark.parametrize("count", [7, 61])  # one worker and two
def test_streamed_frames_are_those_read_from_the_cache(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _stand_in(monkeypatch)
    sequence = open_synth(SPEC.format(count), cache_dir=tmp_path)
    streamed = list(sequence.frames())
    assert [frame.index for frame in streamed] == list(range(count))
    assert [int(frame.image[0, 0, 0]) for frame in streamed] == list(range(count))
    (cached,) = (tmp_path / "synth").iterdir()
    assert {path.name for path in cached.iterdir()} >= {"rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt"}

    monkeypatch.setattr(rendering, "COMMAND", ("/nonexistent",))  # from now on nothing may be started
    again = open_synth(SPEC.format(count), cache_dir=tmp_path)
    assert all(_same(a, b) for a, b in zip(streamed, again.frames(), strict=True))
    assert all(_same(a, b) for a, b in zip(streamed, sequence.frames(), strict=True))
    truth = folder.read_ground_truth(cached)
    assert np.array_equal(truth.stamps_ns, again.ground_truth.stamps_ns)
    assert np.allclose(truth.T_world_cam, again.ground_truth.T_world_cam, atol=1e-8)
    assert folder.read_rig(cached).cam0 == again.rig.cam0


def test_an_abandoned_pass_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stand_in(monkeypatch)
    frames = open_synth(SPEC.format(100), cache_dir=tmp_path).frames()
    next(frames)
    assert len(list((tmp_path / "synth").iterdir())) == 1
    frames.close()  # type: ignore[attr-defined]
    assert list((tmp_path / "synth").iterdir()) == []


def test_a_dead_worker_is_an_error_with_its_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stand_in(monkeypatch, dies_at=3)
    sequence = open_synth(SPEC.format(9), cache_dir=tmp_path)
    with pytest.raises(SeamarkError, match=r"died with code 1 before frame 3: the driver fell over"):
        list(sequence.frames())
    assert list((tmp_path / "synth").iterdir()) == []


def test_a_killed_worker_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "COMMAND", (sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"))
    with RenderPool(specification.parse("loop,frames=3")) as pool, pytest.raises(SeamarkError, match="code -9"):
        next(pool.frames())


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stand_in(monkeypatch)
    (tmp_path / "file").write_text("")
    with pytest.raises(SeamarkError, match=r"cannot be written to the cache .*file"):
        list(open_synth(SPEC.format(2), cache_dir=tmp_path / "file").frames())


def test_a_machine_without_vulkan_gets_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(variable, str(tmp_path / "none.json"))
    with pytest.raises(NoVulkanDevice, match=r"no usable Vulkan device|sapien is not installed") as caught:
        open_synth("loop", cache_dir=tmp_path)
    assert "\n" not in str(caught.value)
    assert "small_loop" in str(caught.value)


def test_a_driver_that_hangs_is_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "COMMAND", (sys.executable, "-c", "import time; time.sleep(60)"))
    with pytest.raises(NoVulkanDevice, match="did not answer"):
        require_renderer(timeout_s=0.3)


def test_a_worker_ends_with_its_parent() -> None:
    code = (
        "import ctypes, sys\nfrom seamark.datasets_synth import worker\nworker._die_with_parent()\n"
        "print('ready', flush=True)\nctypes.PyDLL(None).sleep(60)"  # holds the interpreter, as compiling shaders does
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.5)
        child.stdin.close()
        assert child.wait(20) in (1, -signal.SIGIO)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("maze", "no synthetic world 'maze'; there are loop"),
        ("loop,colour=red", "no setting 'colour=red'; there are frames, seed"),
        ("loop,frames", "no setting 'frames'"),
        ("loop,frames=1", "from 2 to"),
        ("loop,frames=abc", "whole number"),
        ("loop,seed=-1", "whole number"),
        ("loop,sensors=lidar", "there are rgbd, stereo, mono"),
        ("loop,seed=1,seed=2", "given twice"),
        ("", "no synthetic world"),
    ],
)
def test_bad_names_say_what_exists(text: str, message: str) -> None:
    with pytest.raises(SeamarkError, match=message):
        open_synth(text)


def test_the_hash_knows_every_setting() -> None:
    texts = ["loop", "loop,seed=1", "loop,frames=601", "loop,sensors=mono", "loop,size=small", "loop,sensor=cheap"]
    assert len({specification.content_hash(specification.parse(text)) for text in texts}) == len(texts)
    assert specification.parse("loop") == specification.parse("loop, frames=600, sensors=rgbd")


def test_the_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SEAMARK_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert scenario.default_cache_dir() == Path.home() / ".cache" / "seamark"
    monkeypatch.setenv("XDG_CACHE_HOME", "/x")
    assert scenario.default_cache_dir() == Path("/x/seamark")
    monkeypatch.setenv("SEAMARK_CACHE", "/y")
    assert scenario.default_cache_dir() == Path("/y")
