"""The back end as a node: keyframes and candidates in; loops, the map and places out."""

import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from typing import Protocol

from seamark.backend.types import Loop, MapSnapshot, Place
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.types import Keyframe
from seamark.service import topics
from seamark.service.bus import Bus
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.places import PlaceService
from seamark.service.requests import Done
from seamark.vocab.types import Candidates, PlaceObservation

PLACE_WORKERS = 2


class StepOutcome(Protocol):
    """What the node reads of :class:`seamark.backend.slam.StepResult`."""

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Return the verdicts of the step."""
        ...

    @property
    def optimised(self) -> bool:
        """Return whether poses have changed."""
        ...

    @property
    def timings_ms(self) -> Mapping[str, float]:
        """Return the latencies of the stages."""
        ...


class Mapper(Protocol):
    """What the node needs of :class:`seamark.backend.slam.Slam`."""

    def step(self, keyframe: Keyframe, candidates: Candidates) -> StepOutcome:
        """Add a keyframe and verify its candidates."""
        ...

    def finish(self) -> StepOutcome:
        """Settle what is undecided."""
        ...

    def snapshot(self) -> MapSnapshot:
        """Return the map."""
        ...

    def locate(self, keyframe: Keyframe, candidates: Candidates) -> tuple[Place, ...]:
        """Verify a query against the map."""
        ...


class Store(Protocol):
    """What the node needs of :class:`seamark.backend.map_store.MapStore`."""

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Write a keyframe so that it survives a crash."""
        ...

    def add_loop(self, loop: Loop) -> None:
        """Write a verdict."""
        ...

    def update_poses(self, snapshot: MapSnapshot) -> None:
        """Write the poses of a revision."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class BackendNode:
    """Joins keyframes with their candidates and maps them in the order of the keyframes.

    A keyframe is acknowledged when it is on disk, candidates when their keyframe has been mapped. With ``no_loops``
    candidates are ignored. ``known_ids`` are keyframes of the map from before: sent again, they are not added again.
    """

    def __init__(
        self,
        bus: Bus,
        slam: Mapper,
        store: Store | None,
        places: FrontendConfig,
        camera: Camera | None = None,
        *,
        no_loops: bool = False,
        known_ids: Iterable[int] = (),
    ) -> None:
        self._bus, self._slam, self._store, self._no_loops = bus, slam, store, no_loops
        self._meter = Meter(bus.node)
        self._slam_lock = threading.Lock()  # place queries are answered in threads of their own
        self._known = set(known_ids)
        self._waiting: dict[int, Keyframe] = {}  # in the order of arrival, which is that of the keyframes
        self._candidates: dict[int, tuple[Candidates, Future[None]]] = {}
        self._next_session = 0
        place_service = PlaceService(places, camera, self._rank, self._locate)
        bus.handle(topics.DRAIN[bus.node], self._on_drain)
        bus.handle(topics.STATUS[bus.node], lambda _: self._meter.status(), workers=1)
        bus.handle(topics.MAP_SNAPSHOT, lambda _: self._snapshot())
        bus.handle(topics.PLACE, place_service.answer, workers=PLACE_WORKERS)
        bus.handle(topics.CANDIDATES, self._on_candidates)
        bus.handle(topics.KEYFRAME, self._on_keyframe)

    def stop(self) -> None:
        """Map what is waiting, settle what is undecided, and write the poses."""
        for keyframe_id in list(self._waiting):
            self._map(keyframe_id)
        with self._slam_lock, self._meter.timed("finish"):
            outcome = self._slam.finish()
        self._tell(outcome)
        if self._store is not None:
            self._store.update_poses(self._snapshot())

    def close(self) -> None:
        """Close the map's file."""
        if self._store is not None:
            self._store.close()

    def _on_keyframe(self, keyframe: Keyframe) -> None:
        if keyframe.id in self._known:
            self._meter.count("keyframes_again")
            return
        if self._store is not None:
            with self._meter.timed("store"):
                self._store.add_keyframe(keyframe)
        self._known.add(keyframe.id)
        self._waiting[keyframe.id] = keyframe
        self._meter.count("keyframes")
        self._next_session = max(self._next_session, keyframe.session + 1)
        self._meter.keep("next_keyframe_id", max(self._known) + 1)
        self._meter.keep("next_session", self._next_session)
        self._map_ready()

    def _on_candidates(self, candidates: Candidates) -> "Future[None] | None":
        keyframe_id = candidates.query_id
        if keyframe_id in self._known and keyframe_id not in self._waiting:
            self._meter.count("candidates_again")
            return None
        mapped: Future[None] = Future()
        self._candidates[keyframe_id] = candidates, mapped
        self._map_ready()
        return mapped

    def _map_ready(self) -> None:
        """Map waiting keyframes, the oldest first, as far as their candidates have come.

        Candidates come in the order of the keyframes: those of an older one will never come once a newer one's are here
        (the vocabulary has refused that keyframe).
        """
        newest = max(self._candidates, default=-1)
        for keyframe_id in list(self._waiting):
            if not self._no_loops and keyframe_id > newest:
                return
            self._map(keyframe_id)

    def _map(self, keyframe_id: int) -> None:
        keyframe = self._waiting.pop(keyframe_id)
        for old in [number for number in self._candidates if number < keyframe_id]:
            self._candidates.pop(old)[1].set_result(None)  # of a keyframe that never came
        candidates, mapped = self._candidates.pop(keyframe_id, (None, Future[None]()))
        if candidates is None or self._no_loops:
            self._meter.count("candidates_ignored" if self._no_loops else "candidates_missing")
            candidates = Candidates(keyframe_id, keyframe.stamp_ns, ())
        try:
            with self._slam_lock, self._meter.timed("map"):
                outcome = self._slam.step(keyframe, candidates)
            self._tell(outcome)
        except Exception as error:
            mapped.set_exception(error)
            raise
        mapped.set_result(None)

    def _tell(self, outcome: StepOutcome) -> None:
        """Write down and publish what a step has found."""
        self._meter.add(outcome.timings_ms)
        for loop in outcome.loops:
            self._meter.count(f"loops_{loop.reason}")
            if self._store is not None:
                self._store.add_loop(loop)
            self._bus.publish(topics.LOOP, loop)
        if outcome.optimised:
            self._meter.count("optimisations")
            snapshot = self._snapshot()
            if self._store is not None:
                self._store.update_poses(snapshot)
            self._bus.publish(topics.MAP, snapshot)

    def _snapshot(self) -> MapSnapshot:
        with self._slam_lock:
            return self._slam.snapshot()

    def _rank(self, observation: PlaceObservation) -> Candidates:
        self._meter.count("place_queries")
        ranked: Candidates = self._bus.request(topics.PLACES_RANK, observation)
        return ranked

    def _locate(self, keyframe: Keyframe, candidates: Candidates) -> tuple[Place, ...]:
        with self._slam_lock:
            return self._slam.locate(keyframe, candidates)

    def _on_drain(self, _: object) -> Done:
        self.stop()
        return Done(self._bus.node)
