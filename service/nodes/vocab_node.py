"""The vocabulary as a node: keyframes in, ranked places out."""

import contextlib
import logging
import threading
from concurrent.futures import Future
from pathlib import Path

from seamark.backend.errors import MapError
from seamark.backend.map_store import MapStore
from seamark.frontend.types import Keyframe
from seamark.service import topics
from seamark.service.bus import Bus, TimedOutError
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.places_cache import PlacesCache, cache_path, observe, open_index
from seamark.service.nodes.process import run_process
from seamark.service.nodes.settings import NodeSettings
from seamark.service.process_end import leave
from seamark.service.requests import Done, Forget, Status
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

logger = logging.getLogger(__name__)

STOP_PATIENCE_S = 0.5


class VocabNode:
    """Asks the index about every keyframe, then adds it; answers query images without adding them.

    ``index`` holds the places of the map from before; ``cache``, where there is one, keeps it in a file. Where the
    index is ``frozen``, nothing is added.
    """

    def __init__(
        self,
        bus: Bus,
        index: PlaceIndex,
        cache: PlacesCache | None = None,
        meter: Meter | None = None,
        *,
        frozen: bool = False,
    ) -> None:
        self._bus = bus
        self._index = index
        self._cache = cache
        self._frozen = frozen
        self._meter = meter or Meter(bus.node)
        self._lock = threading.Lock()  # queries have a thread of their own: sending keyframes on may take a while
        self._next_keyframe_id = 0
        for number in index.stamps():
            self._next_keyframe_id = max(self._next_keyframe_id, number + 1)
        if len(index):
            self._count_places()
        bus.handle(topics.DRAIN[bus.node], self._on_drain)
        bus.handle(topics.STATUS[bus.node], self._on_status, workers=1)
        bus.handle(topics.PROGRESS[bus.node], self._on_status)
        bus.handle(topics.PLACES_RANK, self._on_rank, workers=1)
        bus.handle(topics.FORGET, self._on_forget)
        bus.handle(topics.KEYFRAME, self._on_keyframe)

    def stop(self) -> None:
        """Wait a little until all candidates are acknowledged."""
        try:
            self._bus.drain(STOP_PATIENCE_S)
        except TimedOutError as error:
            logger.warning("%s; they are given up, and so are their keyframes", error)

    def close(self) -> None:
        """Keep the index for the next start."""
        if self._cache is not None:
            self._cache.close(self._index)

    def _on_keyframe(self, keyframe: Keyframe) -> "Future[None]":
        """Rank and add; the keyframe is acknowledged when its candidates are."""
        observation = observe(keyframe)
        with self._lock, self._meter.timed("rank"):
            known = keyframe.id in self._index  # sent again after a restart
            candidates = self._index.query(observation) if known or self._frozen else self._index.step(observation)
            if self._cache is not None and not known and not self._frozen:
                self._cache.changed(self._index)
        self._meter.count("keyframes_again" if known else "keyframes")
        self._next_keyframe_id = max(self._next_keyframe_id, observation.id + 1)
        self._count_places()
        return self._bus.send(topics.CANDIDATES, candidates)

    def _on_forget(self, forget: Forget) -> None:
        with self._lock:
            for number in forget.keyframe_ids.tolist():
                if number in self._index:
                    self._index.remove(number)
                    if self._cache is not None:
                        self._cache.changed(self._index)
                    self._meter.count("places_forgotten")
        self._meter.keep("places", len(self._index))

    def _count_places(self) -> None:
        self._meter.keep("next_keyframe_id", self._next_keyframe_id)
        self._meter.keep("places", len(self._index))

    def _on_rank(self, observation: PlaceObservation) -> Candidates:
        with self._lock, self._meter.timed("rank_query"):
            return self._index.query(observation)

    def _on_status(self, _: object) -> Status:
        self._meter.keep_refused(self._bus.refused)
        return self._meter.status()

    def _on_drain(self, _: object) -> Done:
        self._bus.drain()
        return Done(self._bus.node)


def _reader(path: Path, localise_only: bool) -> MapStore:
    """Open the map, which the back end is about to write: describing a large one must not keep it from that."""
    if not localise_only:
        with contextlib.suppress(MapError):  # a disk that takes nothing has no room for SQLite's files either
            return MapStore(path, read_only=True, beside_writer=True)
    return MapStore(path, read_only=True)


def build(bus: Bus, settings: NodeSettings) -> VocabNode:
    """Return the node for the settings; raises VocabularyFileError, MapError."""
    path = settings.vocabulary
    vocabulary = Vocabulary.default() if path is None else Vocabulary.load(path)
    if settings.map_path is None:
        return VocabNode(bus, PlaceIndex(vocabulary, settings.config.vocab))
    index, described = PlaceIndex(vocabulary, settings.config.vocab), 0
    if settings.restore:
        with _reader(settings.map_path, settings.localise_only) as store:
            index, described = open_index(store, vocabulary, settings.config.vocab)
    meter = Meter(bus.node)
    meter.keep("places_described_at_start", described)
    kept = settings.patient and not settings.localise_only  # a run ends before anything would be gained
    cache = PlacesCache(cache_path(settings.map_path), meter, described) if kept else None
    if cache is not None:
        cache.write_if_due(index)
    return VocabNode(bus, index, cache, meter, frozen=settings.localise_only)


if __name__ == "__main__":
    leave(run_process(topics.VOCAB, build))
