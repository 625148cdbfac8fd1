"""The cache of rendered sequences: killed and resumed, rendered twice at once, full; a stand-in worker renders."""

import errno
import os
import signal
import subprocess
import sys
from contextlib import closing
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth import folder, rendering, specification
from seamark.datasets_synth.folder import read_coded
from seamark.datasets_synth.scenario import cache_folder, open_synth
from seamark.datasets_synth.writing import write_sequence

STAND_IN = """
import json, sys
import numpy as np
from seamark.datasets_synth.sensor import CodedFrame, code_depth, code_labels, code_picture
from seamark.datasets_synth.worker import HEADER
job = json.loads(sys.stdin.readline())
if "probe_s" in job:
    print("GPU: stand-in")
    sys.exit()
with open("LOG", "a") as log:
    log.write(f"{job['first']} ")
for index in range(job["first"], job["specification"]["frames"], job["step"]):
    noise = np.random.default_rng(index).integers(0, 255, (240, 320, 3), np.uint8)
    labels = code_labels(noise[..., 1] % 13) if job["specification"]["labels"] else b""
    depth = code_depth(noise[..., 0].astype(np.uint16) + 256 * (index % 100))
    coded = CodedFrame(index, code_picture(noise), b"", depth, labels)
    sys.stdout.buffer.write(HEADER.pack(index, *map(len, coded.blobs)) + b"".join(coded.blobs))
    sys.stdout.buffer.flush()
"""
CONSUMER = """
import sys, time
from pathlib import Path
from seamark.datasets_synth import rendering
from seamark.datasets_synth.scenario import open_synth
code, spec, cache, many = sys.argv[1:]
rendering.COMMAND = (sys.executable, "-P", "-c", code)
for frame in open_synth(spec, cache_dir=Path(cache)).frames():
    if frame.index == int(many):
        print("there", flush=True)
        time.sleep(60)
"""
SPEC = "loop,size=small,image=320x240,frames={}"


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    text = STAND_IN.replace("LOG", str(tmp_path / "started"))
    monkeypatch.setattr(rendering, "COMMAND", (sys.executable, "-P", "-c", text))
    return text


def _content(cache: Path) -> dict[str, bytes]:
    (finished,) = (cache / "synth").iterdir()
    return {str(file.relative_to(finished)): file.read_bytes() for file in finished.rglob("*") if file.is_file()}


@pytest.mark.parametrize("count", [24, 90])  # one worker and two
def test_what_a_killed_process_rendered_is_taken_over(count: int, tmp_path: Path, code: str) -> None:
    once, spec = tmp_path / "once", SPEC.format(count)
    assert len(list(open_synth(spec, cache_dir=once).frames())) == count
    (tmp_path / "started").unlink()

    cache = tmp_path / "cache"
    with subprocess.Popen(
        [sys.executable, "-c", CONSUMER, code, spec, str(cache), "11"], stdout=subprocess.PIPE
    ) as consumer:
        assert consumer.stdout is not None
        assert consumer.stdout.readline() == b"there\n"
        consumer.send_signal(signal.SIGKILL)
    (left,) = (cache / "synth").iterdir()
    assert left.name.startswith(".partial-")
    torn = left / "rgb" / "000012.jpg.new"  # a file on which the power went
    torn.write_bytes(b"\xff\xd8")
    (tmp_path / "started").unlink()

    indices = [frame.index for frame in open_synth(spec, cache_dir=cache).frames()]
    assert indices == list(range(count))
    assert min(int(first) for first in (tmp_path / "started").read_text().split()) == 12
    content = _content(cache)
    content.pop("rgb/000012.jpg.new", None)
    assert content == _content(once)


def test_two_passes_at_once_agree_and_leave_one_folder(tmp_path: Path, code: str) -> None:
    first, second = (open_synth(SPEC.format(9), cache_dir=tmp_path).frames() for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.image.tobytes() == b.image.tobytes()
    finished = cache_folder(specification.parse(SPEC.format(9)), tmp_path)
    assert list((tmp_path / "synth").iterdir()) == [finished]
    assert folder.stored(finished, specification.parse(SPEC.format(9)).mode) == 9


def test_two_processes_at_once_leave_one_folder(tmp_path: Path, code: str) -> None:
    cache = tmp_path / "cache"
    arguments = [sys.executable, "-c", CONSUMER, code, SPEC.format(40), str(cache), "-1"]
    processes = [subprocess.Popen(arguments, stderr=subprocess.PIPE) for _ in range(2)]
    for process in processes:
        assert process.communicate(timeout=60)[1] == b""
        assert process.returncode == 0
    assert [path.name[0] == "." for path in (cache / "synth").iterdir()] == [False]
    assert len([name for name in _content(cache) if name.startswith("rgb/")]) == 40


def test_an_interrupted_pass_is_taken_over_and_not_by_those_beside_it(tmp_path: Path, code: str) -> None:
    sequence = open_synth(SPEC.format(20), cache_dir=tmp_path)
    running = sequence.frames()
    next(running)
    (own,) = (tmp_path / "synth").iterdir()
    list(sequence.frames())  # cannot have the folder of the first pass and makes its own
    assert own.is_dir()
    assert len(list(running)) == 19
    assert len(list((tmp_path / "synth").iterdir())) == 1


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_full_disk_is_one_sentence(number: int, tmp_path: Path, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if "000003" in self.name:
            raise OSError(number, os.strerror(number), str(self))
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SeamarkError, match=f"cannot be written to the cache .*{os.strerror(number)}") as caught:
        list(open_synth(SPEC.format(9), cache_dir=tmp_path / "cache").frames())
    assert "\n" not in str(caught.value)
    assert list((tmp_path / "cache" / "synth").iterdir()) == []
    with pytest.raises(SeamarkError, match=f"cannot be written: .*{os.strerror(number)}"):
        write_sequence(SPEC.format(9), "tum", tmp_path / "out", cache_dir=tmp_path / "cache")


def test_labels_are_kept_and_come_back(tmp_path: Path, code: str) -> None:
    spec = SPEC.format(7) + ",labels=1"
    sequence = open_synth(spec, cache_dir=tmp_path / "cache")
    expected = [
        np.random.default_rng(index).integers(0, 255, (240, 320, 3), np.uint8)[..., 1] % 13 for index in range(7)
    ]
    rendered = list(sequence.labels())
    assert all(np.array_equal(a, b) for a, b in zip(rendered, expected, strict=True))
    (tmp_path / "started").unlink()
    again = open_synth(spec, cache_dir=tmp_path / "cache")
    assert [frame.index for frame in again.frames()] == list(range(7))
    assert all(np.array_equal(a, b) for a, b in zip(again.labels(), expected, strict=True))
    write_sequence(spec, "tum", tmp_path / "out", cache_dir=tmp_path / "cache")
    written = cv2.imread(str(tmp_path / "out" / "labels" / "000006.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(written, expected[6])
    assert not (tmp_path / "started").exists()  # nothing was rendered again


def test_a_sequence_without_labels_says_so(tmp_path: Path, code: str) -> None:
    with pytest.raises(SeamarkError, match="has no labels; rendered worlds have them with labels=1"):
        open_synth(SPEC.format(7), cache_dir=tmp_path).labels()
    sequence = open_synth(SPEC.format(7), cache_dir=tmp_path)
    with closing(sequence.frames()) as frames:  # type: ignore[type-var]
        list(islice(frames, 2))
    list(sequence.frames())
    assert not (cache_folder(specification.parse(SPEC.format(7)), tmp_path) / "labels").exists()
    assert read_coded(cache_folder(specification.parse(SPEC.format(7)), tmp_path), 3).labels == b""


def test_what_draws_the_pictures_names_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = specification.parse("loop")
    before = specification.content_hash(wanted)
    read = Path.read_bytes
    changed = {"gbuffer.frag": True, "renderer.py": True, "movers.py": True, "staging.py": False, "toy.py": False}
    for name, matters in changed.items():
        monkeypatch.setattr(Path, "read_bytes", lambda self, name=name: read(self) + b" " * (self.name == name))
        assert (specification.content_hash(wanted) != before) is matters, name
