"""The vocabulary as a node: keyframes in, ranked places out."""

import logging
import sys
import threading
from collections.abc import Iterable
from concurrent.futures import Future

from seamark.backend.map_store import MapStore
from seamark.frontend.types import Keyframe
from seamark.service import topics
from seamark.service.bus import Bus, TimedOutError
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.process import run_process
from seamark.service.nodes.settings import NodeSettings
from seamark.service.requests import Done, Forget
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.types import Candidates, PlaceObservation
from seamark.vocab.vocabulary import Vocabulary

logger = logging.getLogger(__name__)

STOP_PATIENCE_S = 0.5


class VocabNode:
    """Asks the index about every keyframe, then adds it; answers query images without adding them.

    ``known`` are the places of the map from before, in the order in which they were seen.
    """

    def __init__(self, bus: Bus, index: PlaceIndex, known: Iterable[PlaceObservation] = ()) -> None:
        self._bus = bus
        self._index = index
        self._meter = Meter(bus.node)
        self._lock = threading.Lock()  # queries have a thread of their own: sending keyframes on may take a while
        self._next_keyframe_id = 0
        for observation in known:
            index.add(observation)
            self._remember(observation)
        bus.handle(topics.DRAIN[bus.node], self._on_drain)
        bus.handle(topics.STATUS[bus.node], lambda _: self._meter.status(), workers=1)
        bus.handle(topics.PROGRESS[bus.node], lambda _: self._meter.status())
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
        """Nothing is held open."""

    def _on_keyframe(self, keyframe: Keyframe) -> "Future[None]":
        """Rank and add; the keyframe is acknowledged when its candidates are."""
        observation = observe(keyframe)
        with self._lock, self._meter.timed("rank"):
            known = keyframe.id in self._index  # sent again after a restart
            candidates = self._index.query(observation) if known else self._index.step(observation)
        self._meter.count("keyframes_again" if known else "keyframes")
        self._remember(observation)
        return self._bus.send(topics.CANDIDATES, candidates)

    def _on_forget(self, forget: Forget) -> None:
        with self._lock:
            for number in forget.keyframe_ids.tolist():
                if number in self._index:
                    self._index.remove(number)
                    self._meter.count("places_forgotten")
        self._meter.keep("places", len(self._index))

    def _remember(self, observation: PlaceObservation) -> None:
        self._next_keyframe_id = max(self._next_keyframe_id, observation.id + 1)
        self._meter.keep("next_keyframe_id", self._next_keyframe_id)
        self._meter.keep("places", len(self._index))

    def _on_rank(self, observation: PlaceObservation) -> Candidates:
        with self._lock, self._meter.timed("rank_query"):
            return self._index.query(observation)

    def _on_drain(self, _: object) -> Done:
        self._bus.drain()
        return Done(self._bus.node)


def observe(keyframe: Keyframe) -> PlaceObservation:
    """Return what place recognition needs of a keyframe."""
    return PlaceObservation(
        keyframe.id,
        keyframe.session,
        keyframe.stamp_ns,
        keyframe.features.descriptors,
        keyframe.features.points,
        keyframe.thumbnail,
    )


def build(bus: Bus, settings: NodeSettings) -> VocabNode:
    """Return the node for the settings; raises VocabularyFileError, MapError."""
    path = settings.vocabulary
    vocabulary = Vocabulary.default() if path is None else Vocabulary.load(path)
    index = PlaceIndex(vocabulary, settings.config.vocab)
    if settings.map_path is None or not settings.restore:
        return VocabNode(bus, index)
    with MapStore(settings.map_path, read_only=True) as store:
        ids = store.keyframe_ids(recognisable=True)
        return VocabNode(bus, index, (observe(store.keyframe(number)) for number in ids))


if __name__ == "__main__":
    sys.exit(run_process(topics.VOCAB, build))
