"""A copy of a map, also of one that a service is writing."""

from pathlib import Path

from seamark.backend.errors import MapError
from seamark.backend.map_file import sync_to_disk
from seamark.backend.map_store import MapStore


def back_up_map(path: Path, out: Path) -> int:
    """Write the map as it is at this moment to the new file ``out``; return its size in bytes.

    It is on disk when this returns. The writer of the map is not held up. Raises MapError, and leaves nothing, when
    ``out`` exists or cannot be written.
    """
    if out.exists():
        raise MapError(f"{out} exists: a backup writes a new file")
    partial = out.with_name(out.name + ".partial")
    try:
        _remove(partial)  # of a backup that was killed: it may be no database
        with MapStore(path, read_only=True) as store:
            store.copy(partial)
        sync_to_disk(partial)
        partial.rename(out)
        sync_to_disk(out.absolute().parent)
        return out.stat().st_size
    except OSError as error:
        raise MapError(f"{out} cannot be written: {error.strerror}") from error
    finally:
        _remove(partial)


def _remove(path: Path) -> None:
    for one in (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal"))):
        one.unlink(missing_ok=True)
