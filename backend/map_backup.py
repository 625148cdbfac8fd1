"""A copy of a map, also of one that a service is writing."""

from pathlib import Path

from seamark.backend.map_new import new_map
from seamark.backend.map_store import MapStore


def back_up_map(path: Path, out: Path) -> int:
    """Write the map as it is at this moment to the new file ``out``; return its size in bytes.

    It is on disk when this returns. The writer of the map is not held up. Raises MapError, and leaves nothing, when
    ``out`` exists or cannot be written.
    """
    with new_map(out, "backup") as partial, MapStore(path, read_only=True) as store:
        store.copy(partial)
    return out.stat().st_size
