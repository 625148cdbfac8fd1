"""Writes what the back end learns, and knows when the disk takes no more."""

import logging
import shutil
import threading
from collections.abc import Iterable
from concurrent.futures import Future

from seamark.backend.errors import MapError, MapUnwritableError
from seamark.backend.map_contraction import Contracted
from seamark.backend.map_open import MAPPED
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop, MapSnapshot
from seamark.frontend.types import Keyframe
from seamark.service.bus import ErrorCode, RemoteError
from seamark.service.nodes.meter import Meter

logger = logging.getLogger(__name__)

RETRY_EVERY_S = 1.0
ROOM_BYTES = 4 << 20  # free space from which a keyframe is expected to find room
LEARNING = "learning"  # counter of the status: 1, or 0 while the map takes nothing


class MapKeeper:
    """The writing side of a map; all threads of a node may use it.

    ``patient``: a disk that takes no more (full, read-only, failing) stops learning and nothing else. Keyframes are
    refused as BUSY, so that their sender keeps them and sends them again; what was found out is kept and tried again
    every RETRY_EVERY_S, and is acknowledged once it is on disk. Not ``patient``, the MapUnwritableError is raised.
    With ``frozen`` nothing is ever written and keyframes are refused for good.
    """

    def __init__(self, store: MapStore, meter: Meter, *, patient: bool = False, frozen: bool = False) -> None:
        self.store = store
        self._meter, self._patient, self._frozen = meter, patient, frozen
        self._lock = threading.RLock()
        self._loops: dict[tuple[int, int], Loop] = {}  # not yet on disk, and so on
        self._snapshot: MapSnapshot | None = None
        self._mapped: int | None = None
        self._done: list[Future[None]] = []
        self._closed = threading.Event()
        self._retrying: threading.Thread | None = None
        self._meter.keep(LEARNING, int(not frozen and not store.file.read_only))
        if patient and not frozen and store.file.read_only:
            self._degrade(MapUnwritableError(f"the map {store.path} cannot be written"))

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Write a keyframe; raises RemoteError (BUSY) while a patient keeper cannot, MapError for good reasons."""
        if self._frozen:
            raise MapError("this service localises only and learns nothing")
        with self._lock:
            try:
                self._write_pending()
                self.store.add_keyframe(keyframe)
            except MapUnwritableError as error:
                self._degrade(error)
                if not self._patient:
                    raise
                raise RemoteError(ErrorCode.BUSY, f"learning has stopped: {error}") from error
            self._recover()

    def save(
        self,
        loops: Iterable[Loop] = (),
        snapshot: MapSnapshot | None = None,
        mapped: int | None = None,
        done: Future[None] | None = None,
    ) -> None:
        """Write what was found out; ``done`` is done when it is on disk."""
        if self._frozen:
            if done is not None:
                done.set_result(None)
            return
        with self._lock:
            self._loops |= {(loop.query_id, loop.match_id): loop for loop in loops}
            self._snapshot = snapshot or self._snapshot
            self._mapped = self._mapped if mapped is None else mapped
            if done is not None:
                self._done.append(done)
            try:
                self._write_pending()
            except MapUnwritableError as error:
                self._degrade(error)
                if not self._patient:
                    self._done.clear()
                    raise
            else:
                self._recover()

    def contract(self, change: Contracted) -> bool:
        """Forget keyframes; return False, and leave the map as it is, where the disk does not even take that."""
        with self._lock:
            try:
                self._write_pending()
                self.store.contract(change)
            except MapUnwritableError as error:
                self._degrade(error)
                return False
        return True

    def close(self) -> None:
        """Try once more to write what is not on disk yet, and close the map; what was not acknowledged may be lost."""
        self._closed.set()
        retrying = self._retrying
        if retrying is not None:
            retrying.join()
        with self._lock:
            try:
                if not self._frozen:  # it would become the map's writer
                    self._write_pending()
            except MapError as error:
                logger.warning("%s; what is lost had not been acknowledged", error)
            self.store.close()

    def _write_pending(self) -> None:
        if self.store.file.read_only:
            try:
                self.store.take_over()
            except MapError as error:
                raise MapUnwritableError(str(error)) from error
        if not self._loops and self._snapshot is None and self._mapped is None:
            return
        meta = {} if self._mapped is None else {MAPPED: str(self._mapped)}
        self.store.record(self._loops.values(), self._snapshot, meta)
        self._loops, self._snapshot, self._mapped = {}, None, None
        finished, self._done = self._done, []
        for done in finished:
            done.set_result(None)

    def _degrade(self, error: MapUnwritableError) -> None:
        self._meter.count("map_unwritable")
        self._meter.keep(LEARNING, 0)
        if not self._patient or self._retrying is not None or self._closed.is_set():
            return
        logger.error("%s: queries are answered, nothing is learned until it can be written again", error)
        self._retrying = threading.Thread(target=self._retry, name="map-keeper", daemon=True)
        self._retrying.start()

    def _recover(self) -> None:
        if self._retrying is not None:
            logger.warning("the map %s can be written again", self.store.path)
        self._retrying = None
        self._meter.keep(LEARNING, 1)

    def _retry(self) -> None:
        while not self._closed.wait(RETRY_EVERY_S):
            with self._lock:
                if self._retrying is not threading.current_thread():
                    return  # a keyframe came through meanwhile
                try:
                    self._write_pending()
                    if shutil.disk_usage(self.store.path.parent).free < ROOM_BYTES:
                        continue
                    fact = next(iter(self.store.meta().items()), (MAPPED, "-1"))
                    self.store.set_meta(dict([fact]))  # does it take what it has already?
                except MapUnwritableError:
                    continue
                except MapError:
                    logger.exception("what was found out cannot be written")
                    continue
                self._recover()
                return
