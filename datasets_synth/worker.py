"""The child process that renders: ``python -m seamark.datasets_synth.worker``; nothing else ever loads SAPIEN.

It reads one JSON line from standard input (``probe_s``, or a specification with first index and step) and writes
frames as headers and blobs to standard output. While it renders, standard input stays open as a life line: when the
parent goes, so does the child.
"""

import fcntl
import json
import os
import signal
import struct
import sys
import threading
from typing import Any, BinaryIO

HEADER = struct.Struct("<iIIII")  # index, bytes of the left picture, the right picture, the depth image, the labels


def _die_with_parent() -> None:
    """End the process when standard input closes.

    A signal does it, because compiling shaders holds the interpreter for many seconds and no thread of Python would run
    then; a thread is there for a pipe that has closed already.
    """
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)
    threading.Thread(target=_wait_for_end, daemon=True).start()


def _wait_for_end() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def _private_output() -> BinaryIO:
    """Return the pipe to the parent, and let everything that libraries print go to standard error."""
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return pipe


def _render(job: dict[str, Any], output: BinaryIO) -> None:
    import cv2

    from seamark.datasets_synth.specification import Specification
    from seamark.datasets_synth.studio import Studio

    cv2.setNumThreads(1)
    specification = Specification(**job["specification"])
    studio = Studio(specification)
    for index in job.get("indices") or range(job["first"], specification.frames, job["step"]):
        coded = studio.frame(index)
        output.write(HEADER.pack(index, *(len(blob) for blob in coded.blobs)))
        for blob in coded.blobs:
            output.write(blob)
        output.flush()


def main() -> None:
    """Do the job that standard input names, then exit."""
    output = _private_output()
    job = json.loads(sys.stdin.buffer.readline())
    if "probe_s" in job:
        signal.alarm(job["probe_s"])  # a driver that hangs must not outlive its parent
        from seamark.datasets_synth.renderer import devices

        output.write(devices().encode())
    else:
        _die_with_parent()
        _render(job, output)
    output.close()
    sys.stderr.flush()
    os._exit(0)  # drivers have been seen to hang in their exit handlers


if __name__ == "__main__":
    main()
