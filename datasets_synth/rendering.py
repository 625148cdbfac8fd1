"""The parent's side of rendering: is there a device, and frames from worker processes in order."""

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from types import TracebackType
from typing import IO, Self

from seamark import SeamarkError
from seamark.datasets_synth.sensor import CodedFrame
from seamark.datasets_synth.specification import Specification
from seamark.datasets_synth.worker import HEADER

COMMAND = (sys.executable, "-P", "-m", "seamark.datasets_synth.worker")
PROBE_TIMEOUT_S = 60.0
POLL_S = 0.5
FRAME_TIMEOUT_S = 240.0  # a worker takes seconds of CPU to build its world, on a loaded machine minutes
FRAMES_AHEAD = 12  # per worker: coded frames that wait for the consumer
FRAMES_FOR_TWO_WORKERS = 60  # below that a second start-up costs more than it brings


class NoVulkanDevice(SeamarkError):  # noqa: N818 - a state of the machine
    """Nothing on this machine can render: sapien or a Vulkan device is missing."""


def require_renderer(timeout_s: float = PROBE_TIMEOUT_S) -> str:
    """Return a summary of the rendering devices, found in a child process; raises NoVulkanDevice with the reason."""
    advice = "synthetic worlds cannot be rendered here; the kept sequence synth:small_loop needs no renderer"
    try:
        job = json.dumps({"probe_s": int(timeout_s) + 5}).encode() + b"\n"
        answer = subprocess.run(COMMAND, input=job, capture_output=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise NoVulkanDevice(f"the Vulkan driver did not answer within {timeout_s:.0f} s: {advice}") from error
    if answer.returncode == 0 and answer.stdout:
        return answer.stdout.decode(errors="replace")
    complaint = answer.stderr.decode(errors="replace").strip().splitlines()[-1:]
    if complaint and "No module named 'sapien'" in complaint[0]:
        raise NoVulkanDevice(f"the package sapien is not installed: {advice}")
    reason = complaint[0] if complaint else f"the probe ended with code {answer.returncode}"
    raise NoVulkanDevice(f"there is no usable Vulkan device ({reason}): {advice}")


class _Worker:
    """One child process and the thread that reads its frames into a bounded queue."""

    def __init__(self, specification: Specification, first: int, step: int, indices: Sequence[int] = ()) -> None:
        environment = {"LP_NUM_THREADS": "1" if step > 1 else "2", "OPENBLAS_NUM_THREADS": "1", **os.environ}
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the worker
        self._process = subprocess.Popen(
            COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, env=environment
        )
        job = {"specification": asdict(specification), "first": first, "step": step, "indices": [*indices]}
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(job).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has died already; next_frame says why
        self._frames: queue.Queue[CodedFrame | None] = queue.Queue(FRAMES_AHEAD)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"render-{first}", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        """Read frames until the pipe ends; None in the queue says that it has."""
        assert self._process.stdout is not None
        while not self._stop.is_set():
            header = self._process.stdout.read(HEADER.size)
            frame = None
            if len(header) == HEADER.size:
                index, *lengths = HEADER.unpack(header)
                blobs = [self._process.stdout.read(length) for length in lengths]
                if [len(blob) for blob in blobs] == lengths:
                    frame = CodedFrame(index, *blobs)
            self._put(frame)
            if frame is None:
                return

    def _put(self, frame: CodedFrame | None) -> None:
        while not self._stop.is_set():
            try:
                return self._frames.put(frame, timeout=POLL_S)
            except queue.Full:
                continue
        return None

    def next_frame(self, index: int) -> CodedFrame:
        """Return frame ``index``, which is the next of this worker; raises SeamarkError where the worker has died."""
        try:
            frame = self._frames.get(timeout=FRAME_TIMEOUT_S)
        except queue.Empty:
            raise SeamarkError(f"the rendering process gave no frame {index} within {FRAME_TIMEOUT_S:.0f} s") from None
        if frame is None or frame.index != index:
            code = self._process.wait()
            self._errors.seek(0)
            last = self._errors.read().decode(errors="replace").strip().splitlines()[-1:]
            reason = last[0] if last else "it left no message"
            raise SeamarkError(f"the rendering process died with code {code} before frame {index}: {reason}")
        return frame

    @property
    def pid(self) -> int:
        """Return the process id of the child."""
        return self._process.pid

    def close(self) -> None:
        """Kill the child, whatever it does, and free its pipes."""
        self._stop.set()
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for pipe in (self._process.stdin, self._process.stdout, self._errors):
            if pipe is not None:
                try:
                    pipe.close()
                except BrokenPipeError:
                    continue


class RenderPool:
    """One or two worker processes that render a specification; a context manager that ends them on leaving.

    Frames before ``begin`` are left out.
    """

    def __init__(self, specification: Specification, begin: int = 0) -> None:
        self._specification = specification
        self._begin = begin
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        """Start the workers."""
        few = self._specification.frames - self._begin < FRAMES_FOR_TWO_WORKERS or (os.cpu_count() or 1) < 2
        count = 1 if few else 2
        try:
            for first in range(count):
                self._workers.append(_Worker(self._specification, self._begin + first, count))
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End the workers."""
        self.close()

    @property
    def pids(self) -> list[int]:
        """Return the process ids of the workers."""
        return [worker.pid for worker in self._workers]

    def frames(self) -> Iterator[CodedFrame]:
        """Yield all frames in order; raises SeamarkError where a worker dies."""
        for index in range(self._begin, self._specification.frames):
            yield self._workers[(index - self._begin) % len(self._workers)].next_frame(index)

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.close()
        self._workers = []


def render_some(specification: Specification, indices: Sequence[int]) -> Iterator[CodedFrame]:
    """Yield the frames with the given ascending indices only; raises SeamarkError where the worker dies."""
    worker = _Worker(specification, 0, 1, indices)
    try:
        for index in indices:
            yield worker.next_frame(index)
    finally:
        worker.close()
