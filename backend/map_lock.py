"""Who may write a map: one process at a time, whatever becomes of the last one."""

import fcntl
import logging
import os
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from seamark.backend.errors import MapInUseError

logger = logging.getLogger(__name__)

Inode = tuple[int, int]


@dataclass
class _Held:
    """What this process has open of one file."""

    users: int = 0
    descriptors: list[int] = field(default_factory=list)


_WHO: Final = {
    True: ", which reads it as it is (map export, map check or a service that only localises)",
    False: ", which writes it",
}
_GUARD: Final = threading.Lock()
_HELD: Final[dict[Inode, _Held]] = {}


class MapLock:
    """A lock on an existing map file until ``close`` or any end of the process; harmless to close twice.

    ``exclusive``: the one writer; two would number their keyframes alike and overwrite one another's. Raises
    MapInUseError when another has it, or while somebody reads the file undisturbed. Otherwise ``undisturbed`` says
    whether there is no writer and none will come before ``close``.

    Closing any descriptor of a file drops the locks that SQLite, in the same process, holds on it. Descriptors are
    therefore closed with the last of this process's locks on the file, so close the database before its lock.
    """

    def __init__(self, path: Path, exclusive: bool) -> None:
        descriptor = os.open(path, os.O_RDONLY)
        status = os.fstat(descriptor)
        self._inode: Inode = (status.st_dev, status.st_ino)
        self._descriptor: int | None = descriptor
        with _GUARD:
            held = _HELD.setdefault(self._inode, _Held())
            held.users += 1
            held.descriptors.append(descriptor)
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
            self.undisturbed = True
        except BlockingIOError as error:
            self.undisturbed = False
            if exclusive:
                by_readers = _readers_have(descriptor)
                self.close()
                raise MapInUseError(
                    f"the map {path} is in use by another process{_WHO[by_readers]}", by_readers
                ) from error
        except OSError:  # a file system without locks
            self.undisturbed = False
            logger.warning("the map %s cannot be locked: keep other services from it", path)

    def close(self) -> None:
        """Give the lock back."""
        if self._descriptor is None:
            return
        fcntl.flock(self._descriptor, fcntl.LOCK_UN)
        self._descriptor = None
        with _GUARD:
            held = _HELD[self._inode]
            held.users -= 1
            if held.users == 0:
                for descriptor in held.descriptors:
                    os.close(descriptor)
                del _HELD[self._inode]


def _readers_have(descriptor: int) -> bool:
    """Return whether it is readers who hold the lock that was refused."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
