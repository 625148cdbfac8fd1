"""The features of keyframes in memory, within a budget; the others are read from the map when they are needed."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import replace

from seamark.backend.errors import MapError
from seamark.backend.map_codec import NO_LANDMARKS, NO_THUMBNAIL
from seamark.frontend.types import Features, Keyframe

logger = logging.getLogger(__name__)

Load = Callable[[int], Keyframe]


class KeyframeMemory:
    """Features, landmarks and depth of keyframes; the least recently used give way beyond ``budget_bytes``.

    ``load`` reads a keyframe of the map; without it nothing gives way. May be shared by threads.
    """

    def __init__(self, budget_bytes: int, load: Load | None = None) -> None:
        self._budget_bytes, self._load = budget_bytes, load
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, Keyframe] = OrderedDict()
        self._bytes = 0
        self._forgotten: set[int] = set()
        self.loads = 0

    @property
    def n_bytes(self) -> int:
        """Return how many bytes the kept features take."""
        return self._bytes

    def add(self, keyframe: Keyframe) -> Keyframe:
        """Keep a keyframe's features; return the keyframe without them, without image and thumbnail."""
        if not len(keyframe.features) and not keyframe.jpeg and not keyframe.thumbnail.size:
            return keyframe  # as a map gives those that were there before
        if len(keyframe.features):
            self._keep(replace(keyframe, jpeg=b"", thumbnail=NO_THUMBNAIL))
        return replace(
            keyframe, features=Features.empty(), landmarks=NO_LANDMARKS, jpeg=b"", thumbnail=NO_THUMBNAIL, depth=b""
        )

    def whole(self, keyframe: Keyframe) -> Keyframe:
        """Return a keyframe with its features, as it is where they have been forgotten or cannot be read."""
        with self._lock:
            kept = self._kept.get(keyframe.id)
            if kept is not None:
                self._kept.move_to_end(keyframe.id)
                return kept
            if self._load is None or keyframe.id in self._forgotten:
                return keyframe
            self.loads += 1
        try:
            loaded = self._load(keyframe.id)
        except MapError as error:
            logger.error("keyframe %d cannot be compared: %s", keyframe.id, error)
            return keyframe
        whole = replace(keyframe, features=loaded.features, landmarks=loaded.landmarks, depth=loaded.depth)
        if len(loaded.features):
            self._keep(whole)
        return whole

    def forget(self, keyframe_ids: Iterable[int]) -> None:
        """Drop the features of keyframes that the map no longer has, and do not look for them there."""
        with self._lock:
            self._forgotten.clear()
            for number in keyframe_ids:
                self._forgotten.add(number)
                gone = self._kept.pop(number, None)
                self._bytes -= 0 if gone is None else _size(gone)

    def _keep(self, keyframe: Keyframe) -> None:
        with self._lock:
            if keyframe.id in self._kept or keyframe.id in self._forgotten:
                return
            self._kept[keyframe.id] = keyframe
            self._bytes += _size(keyframe)
            while self._load is not None and self._bytes > self._budget_bytes and len(self._kept) > 1:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= _size(oldest)


def _size(keyframe: Keyframe) -> int:
    features = keyframe.features
    arrays = (features.points, features.scales, features.angles, features.descriptors, keyframe.landmarks)
    return sum(array.nbytes for array in arrays) + len(keyframe.depth)
