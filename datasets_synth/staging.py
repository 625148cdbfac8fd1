"""Folders that grow beside their final place: what a killed process leaves is taken over by the next one.

The owner holds a lock on the folder itself, which ends with it and goes along when the folder is renamed.
"""

import contextlib
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

Locked = tuple[Path, int]  # a folder and the descriptor that locks it


@contextlib.contextmanager
def growing(finished: Path) -> Iterator[Path]:
    """Yield a folder that no other process has: one that was left on the way to ``finished``, or else an empty one.

    Rename it to ``finished`` once it is complete. Whatever is left of it then, and after an error, is removed; only an
    interruption from the keyboard leaves it, as a kill does. Raises OSError.
    """
    finished.parent.mkdir(parents=True, exist_ok=True)
    partial, lock = _take_over(finished) or _begin(finished)
    kept = False
    try:
        yield partial
    except KeyboardInterrupt:
        kept = True
        raise
    finally:
        if not kept:
            shutil.rmtree(partial, ignore_errors=True)
        os.close(lock)
        if finished.is_dir():
            _remove_others(finished)


def _begin(finished: Path) -> Locked:
    while True:
        partial = _name(finished, uuid.uuid4().hex[:8])
        partial.mkdir()
        if locked := _lock(partial):
            return locked


def _take_over(finished: Path) -> Locked | None:
    found = (_lock(leftover) for leftover in sorted(finished.parent.glob(_name(finished, "*").name)))
    return next((locked for locked in found if locked), None)


def _remove_others(finished: Path) -> None:
    while left := _take_over(finished):
        shutil.rmtree(left[0], ignore_errors=True)
        os.close(left[1])
        if left[0].exists():  # it cannot be removed
            return


def _name(finished: Path, mark: str) -> Path:
    return finished.with_name(f".partial-{finished.name}-{mark}")


def _lock(folder: Path) -> Locked | None:
    """Return the folder if it is there and nobody else's."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if folder.stat().st_ino == os.fstat(descriptor).st_ino:  # not renamed or removed meanwhile
            return folder, descriptor
    except OSError:
        pass
    os.close(descriptor)
    return None
