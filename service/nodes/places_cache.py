"""The place index kept in a file beside the map, so that a restart need not describe every keyframe again.

The map is the truth and the file saves time, nothing else: whatever is missing, damaged, of another vocabulary or other
settings, or does not agree with the map, is made anew from the map.
"""

import logging
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from seamark.backend.map_store import MapStore
from seamark.frontend.types import Keyframe
from seamark.service.nodes.meter import Meter
from seamark.vocab.config import VocabConfig
from seamark.vocab.errors import IndexFileError
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

logger = logging.getLogger(__name__)

SUFFIX: Final = ".places"
COMPARED: Final = 16  # keyframes, evenly spread, that are described again to see whether the file is of this map
LEAST_CHANGES, SHARE_OF_PLACES = 256, 0.1
"""So many places must have changed before the file is written: describing fewer again takes half a second."""


class PlacesCache:
    """Writes the place index of a map in the background, as it changes.

    ``changes`` are places that the file does not hold yet. A disk that takes no more costs a counter and a line in the
    log.
    """

    def __init__(self, path: Path, meter: Meter, changes: int = 0) -> None:
        self._path, self._meter = path, meter
        self._changes = changes
        self._writing: threading.Thread | None = None
        for left_over in path.parent.glob(f".{path.name}.*"):  # of a process that was killed while it wrote
            left_over.unlink(missing_ok=True)

    def changed(self, index: PlaceIndex) -> None:
        """Note that a place was added or removed; from time to time this begins to write the index."""
        self._changes += 1
        self.write_if_due(index)

    def write_if_due(self, index: PlaceIndex) -> None:
        """Begin to write the index if much has changed: after a start that described a whole map, at once."""
        idle = self._writing is None or not self._writing.is_alive()
        if idle and self._changes >= max(LEAST_CHANGES, SHARE_OF_PLACES * len(index)):
            self._begin(index)

    def close(self, index: PlaceIndex) -> None:
        """Write what has changed, if it is worth it, and wait for it."""
        if self._writing is not None:
            self._writing.join()
        if self._changes >= LEAST_CHANGES:
            self._begin(index)
        if self._writing is not None:
            self._writing.join()

    def _begin(self, index: PlaceIndex) -> None:
        self._changes = 0
        self._writing = threading.Thread(target=self._write, args=(index,), name="places-cache")
        self._writing.start()

    def _write(self, index: PlaceIndex) -> None:
        try:
            index.save(self._path)
        except IndexFileError as error:
            self._meter.count("places_unwritable")
            logger.warning("%s; the next start will take longer", error)
        else:
            self._meter.count("places_written")


def observe(keyframe: Keyframe) -> PlaceObservation:
    """Return what place recognition needs of a keyframe."""
    return PlaceObservation(
        keyframe.id,
        keyframe.session,
        keyframe.stamp_ns,
        keyframe.features.descriptors,
        keyframe.features.points,
        keyframe.thumbnail,
        keyframe.features.scales,
        keyframe.features.angles,
    )


def cache_path(map_path: Path) -> Path:
    """Return the file that keeps the place index of a map."""
    return map_path.with_name(map_path.name + SUFFIX)


def open_index(store: MapStore, vocabulary: Vocabulary, config: VocabConfig) -> tuple[PlaceIndex, int]:
    """Return the index of all recognisable keyframes of a map, and how many of them had to be described."""
    recognisable = store.keyframe_ids(recognisable=True)
    index = _agreeing(store, recognisable, vocabulary, config)
    missing = recognisable
    if index is not None:
        missing = [number for number in recognisable if number not in index]
        newest = max((number for number in recognisable if number in index), default=-1)
        if missing and missing[0] < newest:  # places are added in the order in which they were seen
            index = None
    if index is None:
        index, missing = PlaceIndex(vocabulary, config), recognisable
    for number in missing:
        index.add(observe(store.keyframe(number)))
    return index, len(missing)


def _agreeing(
    store: MapStore, recognisable: list[int], vocabulary: Vocabulary, config: VocabConfig
) -> PlaceIndex | None:
    """Return what the file holds of the map's places, or None where it is of no use."""
    path = cache_path(store.path)
    if not path.exists():
        return None
    try:
        index = PlaceIndex.load(path, vocabulary, config)
        kept = index.stamps()
    except IndexFileError as error:
        logger.warning("%s; it is made again from the map", error)
        return None
    known = set(recognisable)
    stamps = {node.id: (node.session, node.stamp_ns) for node in store.load_nodes() if node.id in known}
    _remove(index, (number for number, stamp in kept.items() if stamps.get(number) != stamp))
    same = [number for number in recognisable if number in index]
    for at in np.unique(np.linspace(0, len(same) - 1, COMPARED).round().astype(int)) if same else ():
        if not index.describes(observe(store.keyframe(same[at]))):
            logger.warning("%s: of another map; it is made again", path)
            return None
    return index


def _remove(index: PlaceIndex, numbers: Iterable[int]) -> None:
    for number in list(numbers):
        index.remove(number)
