"""A new map file that is there once it is whole, and not before."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from seamark.backend.errors import MapError
from seamark.backend.map_file import sync_to_disk


@contextmanager
def new_map(out: Path, what: str) -> Iterator[Path]:
    """Give the name under which ``what`` makes its map; it becomes ``out`` when that is done, and durable.

    Raises MapError, and leaves nothing, when ``out`` exists or cannot be written.
    """
    if out.exists():
        raise MapError(f"{out} exists: a {what} writes a new file")
    partial = out.with_name(out.name + ".partial")
    try:
        _remove(partial)  # of one that was killed: it may be no database
        yield partial
        sync_to_disk(partial)
        partial.rename(out)
        sync_to_disk(out.absolute().parent)
    except OSError as error:
        raise MapError(f"{out} cannot be written: {error.strerror}") from error
    finally:
        _remove(partial)


def _remove(path: Path) -> None:
    for one in (path, *(path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal"))):
        one.unlink(missing_ok=True)
