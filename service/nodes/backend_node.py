"""The back end as a node: keyframes and candidates in; loops, the map and places out."""

import logging
import threading
import time
from collections.abc import Collection
from concurrent.futures import Future

import numpy as np

from seamark.backend.config import MapConfig
from seamark.backend.errors import MapError
from seamark.backend.graph_types import Solver
from seamark.backend.map_open import loader, open_passing, restore
from seamark.backend.map_store import MapStore
from seamark.backend.slam import Slam, StepResult
from seamark.backend.solver import SolverProcess
from seamark.backend.types import MapSnapshot
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.types import Keyframe, Mode
from seamark.service import topics
from seamark.service.bus import Bus, BusError
from seamark.service.nodes.keyframe_queue import KeyframeQueue
from seamark.service.nodes.map_keeper import MapKeeper
from seamark.service.nodes.map_opening import open_map
from seamark.service.nodes.map_pruner import MapPruner
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.places import PlaceService
from seamark.service.nodes.places_cache import observe
from seamark.service.nodes.process import run_process
from seamark.service.nodes.settings import NodeSettings
from seamark.service.process_end import leave
from seamark.service.requests import Done, Forget, Status
from seamark.vocab.types import Candidates, PlaceObservation

PLACE_WORKERS = 2
STOP_PATIENCE_S = 0.5
STORING_S = 10.0  # for which the order to store alone holds: whoever gave it may not be the service

logger = logging.getLogger(__name__)


class BackendNode:
    """Joins keyframes with their candidates and maps them in the order of the keyframes.

    A keyframe is acknowledged when it is on disk, candidates when their keyframe has been mapped. With ``no_loops``
    candidates are ignored. What ``store`` holds already is taken in first. ``solver`` is closed with the node.
    ``patient`` and ``frozen``: see :class:`~seamark.service.nodes.map_keeper.MapKeeper`. With ``passing`` keyframes go
    to that file (see :func:`~seamark.backend.map_open.open_passing`) and ``store`` stays as it is.
    """

    def __init__(
        self,
        bus: Bus,
        slam: Slam,
        store: MapStore | None,
        places: FrontendConfig,
        camera: Camera | None = None,
        *,
        no_loops: bool = False,
        solver: Solver | None = None,
        patient: bool = False,
        frozen: bool = False,
        passing: MapStore | None = None,
        limits: MapConfig | None = None,
    ) -> None:
        self._bus, self._slam, self._no_loops, self._solver = bus, slam, no_loops, solver
        self._meter = Meter(bus.node)
        self._keeper = None
        if store is not None:
            self._keeper = MapKeeper(passing or store, self._meter, patient=patient, frozen=frozen and passing is None)
        self._store = store
        self._pruner = None
        if self._keeper is not None and passing is None:
            self._pruner = MapPruner(self._keeper, slam, limits or MapConfig(), self._meter, self._forget)
        self._lock = threading.RLock()  # stop comes from another thread than the messages
        self._settled = True
        self._next_keyframe_id = 0
        self._next_session = 0
        self._queue = KeyframeQueue()
        self._storing_until = 0.0  # time.monotonic: keyframes are stored and not mapped
        if store is not None:
            self._restore(store, passing)
        place_service = PlaceService(places, camera, self._rank, slam.locate)
        bus.handle(topics.DRAIN[bus.node], self._on_drain)
        bus.handle(topics.STATUS[bus.node], lambda _: self._status(), workers=1)
        bus.handle(topics.PROGRESS[bus.node], lambda _: self._status())
        bus.handle(topics.MAP_SNAPSHOT, lambda _: self._slam.snapshot(), workers=1)
        bus.handle(topics.STOPPING, self._on_stopping, workers=1)
        bus.handle(topics.PLACE, place_service.answer, workers=PLACE_WORKERS)
        bus.handle(topics.CANDIDATES, self._on_candidates)
        bus.handle(topics.KEYFRAME, self._on_keyframe)

    def stop(self) -> None:
        """Map what is waiting, as far as that goes quickly, and write the poses as they are.

        What is still waiting then is on disk, and mapped after the next start.
        """
        deadline = time.monotonic() + STOP_PATIENCE_S
        with self._lock:
            for keyframe_id in self._mappable():
                if time.monotonic() > deadline:
                    break
                self._map(keyframe_id)
            if not self._settled and self._keeper is not None:
                self._keeper.save(snapshot=self._slam.snapshot())

    def settle(self) -> None:
        """Map what is waiting, settle what is undecided, and write the poses; it may take its time."""
        with self._lock:
            for keyframe_id in self._queue.everyone():
                self._map(keyframe_id)
            if self._settled:
                return
            with self._meter.timed("finish"):
                result = self._slam.finish()
            self._tell(result)
            if self._keeper is not None and not result.optimised:
                self._keeper.save(snapshot=self._slam.snapshot())
            self._settled = True

    def close(self) -> None:
        """Close the map's file and end the solver."""
        if self._keeper is not None:
            self._keeper.close()
        if self._store is not None:
            self._store.close()
        if self._solver is not None:
            self._solver.close()

    def _restore(self, store: MapStore, passing: MapStore | None) -> None:
        """Take in the map from before; keyframes stored and not yet mapped wait for their candidates again."""
        before, waiting = restore(self._slam, store, held=passing is not None)
        if passing is not None:
            own, waiting_own = restore(self._slam, passing, solve=True)
            before, waiting = before + own, waiting + waiting_own
        for keyframe in (*before, *waiting):
            self._remember(keyframe)
        self._queue.restore(waiting)
        self._meter.keep("keyframes_restored", len(before))

    def _remember(self, keyframe: Keyframe) -> None:
        self._next_keyframe_id = max(self._next_keyframe_id, keyframe.id + 1)
        self._next_session = max(self._next_session, keyframe.session + 1)
        self._meter.keep("next_keyframe_id", self._next_keyframe_id)
        self._meter.keep("next_session", self._next_session)

    def _on_keyframe(self, keyframe: Keyframe) -> None:
        with self._lock:
            if keyframe.id < self._next_keyframe_id:  # they come in order
                self._meter.count("keyframes_again")
                return
            if self._keeper is not None:
                try:
                    with self._meter.timed("store"):
                        self._keeper.add_keyframe(keyframe)
                except MapError:
                    self._queue.refuse(keyframe.id)
                    raise
            self._remember(keyframe)
            self._queue.add(keyframe)
            self._settled = False
            self._meter.count("keyframes")
            self._map_ready()

    def _status(self) -> Status:
        self._meter.keep("feature_bytes", self._slam.feature_bytes)
        self._meter.keep("localised", int(self._slam.localised))
        self._meter.keep_refused(self._bus.refused)
        return self._meter.status()

    def _on_candidates(self, candidates: Candidates) -> "Future[None] | None":
        keyframe_id = candidates.query_id
        with self._lock:
            mapped_before = keyframe_id < self._next_keyframe_id and keyframe_id not in self._queue
            if mapped_before or self._queue.refused(keyframe_id):
                self._meter.count("candidates_again")
                return None
            mapped = self._queue.put(candidates)
            if time.monotonic() < self._storing_until:
                return None  # their keyframe is on disk, or comes to be, and finds them again
            self._map_ready()
        return mapped

    def _map_ready(self) -> None:
        """Map waiting keyframes, the oldest first, as far as their candidates have come."""
        for keyframe_id in self._mappable():
            if time.monotonic() < self._storing_until:
                return
            self._map(keyframe_id)

    def _mappable(self) -> list[int]:
        """Return the waiting keyframes that need not wait for their candidates any more."""
        return self._queue.everyone() if self._no_loops else self._queue.ready()

    def _map(self, keyframe_id: int) -> None:
        arrived = self._queue.take(keyframe_id)
        keyframe, candidates, mapped = arrived.keyframe, arrived.candidates, arrived.mapped
        if candidates is None and arrived.left and not self._no_loops:
            candidates = self._ask_again(keyframe)
        if candidates is None or self._no_loops:
            self._meter.count("candidates_ignored" if self._no_loops else "candidates_missing")
            candidates = Candidates(keyframe_id, keyframe.stamp_ns, ())
        self._settled = False
        try:
            with self._meter.timed("map"):
                result = self._slam.step(keyframe, candidates)
            self._tell(result, keyframe_id, mapped)
        except Exception as error:
            if not mapped.done():  # it is on disk where only telling of it has failed, as when the bus is closed
                mapped.set_exception(error)
            raise
        if self._pruner is not None:
            self._pruner.mapped(keyframe_id)

    def _tell(self, result: StepResult, mapped_id: int | None = None, mapped: "Future[None] | None" = None) -> None:
        """Write down and publish what a step has found; ``mapped`` is done when it is on disk."""
        self._meter.add(result.timings_ms)
        snapshot: MapSnapshot | None = self._slam.snapshot() if result.optimised else None
        if self._keeper is not None:
            self._keeper.save(result.loops, snapshot, mapped_id, mapped)
        elif mapped is not None:
            mapped.set_result(None)
        for loop in result.loops:
            self._meter.count(f"verdicts_{loop.reason}")
            self._bus.publish(topics.LOOP, loop)
        if snapshot is not None:
            self._meter.count("optimisations")
            self._bus.publish(topics.MAP, snapshot)

    def _forget(self, keyframe_ids: Collection[int]) -> None:
        """Have the vocabulary drop places that the map no longer has."""
        self._bus.send(topics.FORGET, Forget(np.array(sorted(keyframe_ids), np.int64)))

    def _rank(self, observation: PlaceObservation) -> Candidates:
        self._meter.count("place_queries")
        ranked: Candidates = self._bus.request(topics.PLACES_RANK, observation)
        return ranked

    def _ask_again(self, keyframe: Keyframe) -> Candidates | None:
        """Return the candidates of a keyframe that an earlier life has left unmapped, None where nobody knows."""
        try:
            candidates: Candidates = self._bus.request(topics.PLACES_RANK, observe(keyframe))
        except BusError as error:
            logger.warning("keyframe %d is mapped without candidates: %s", keyframe.id, error)
            return None
        self._meter.count("candidates_asked_again")
        return candidates

    def _on_stopping(self, _: object) -> Done:
        self._storing_until = time.monotonic() + STORING_S
        return Done(self._bus.node)

    def _on_drain(self, _: object) -> Done:
        self.settle()
        return Done(self._bus.node)


def build(bus: Bus, settings: NodeSettings) -> BackendNode:
    """Return the node for the settings; raises MapError and its kin when the map cannot be used."""
    config, mode = settings.config, settings.mode
    store, passing = open_map(settings), None
    solver: Solver | None = None
    try:
        if settings.passing_path is not None:
            passing = open_passing(settings.passing_path)
        if mode is not Mode.PLACES:
            solver = _solver(settings)
        return BackendNode(
            bus,
            Slam(config.backend, mode, solver, config.seed, None if store is None else loader(store, passing)),
            store,
            config.frontend,
            settings.rig.cam0 if settings.rig else None,
            no_loops=settings.no_loops,
            solver=solver,
            patient=settings.patient,
            frozen=settings.localise_only,
            passing=passing,
            limits=config.backend.map,
        )
    except BaseException:
        if solver is not None:
            solver.close()
        for opened in (passing, store):
            if opened is not None:
                opened.close()
        raise


def _solver(settings: NodeSettings) -> Solver:
    if settings.solver_process:
        return SolverProcess(settings.config.backend)
    from seamark.backend.pose_graph import PoseGraph  # loads GTSAM, which the node's own process does without

    return PoseGraph(settings.config.backend)


if __name__ == "__main__":
    leave(run_process(topics.BACKEND, build))
