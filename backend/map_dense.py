"""All that the depth images of a map show, as coloured points."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.map_reader import FEATURES, IMAGES
from seamark.backend.map_store import MapStore
from seamark.backend.surfaces import Surface, surface_of
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

ROW: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)  # as PLY names them


def dense_points(store: MapStore, poses: Mapping[int, tuple[NDArray[np.float64], float]]) -> Iterator[NDArray[np.void]]:
    """Yield for each keyframe the points of its surfaces in the map's frame (N,) of ROW, read one keyframe at a time.

    ``poses`` are T_map_cam and scale by id. Points at edges, without a normal, are left out; grey where the image
    cannot be read.
    """
    for number in store.keyframe_ids(recognisable=True):
        if number not in poses:
            continue
        keyframe = store.keyframe(number, (FEATURES, IMAGES))
        seen = surface_of(keyframe)
        if seen is None:
            continue
        known = np.flatnonzero(np.isfinite(seen.normals[:, 0]))
        rows = np.zeros(len(known), ROW)
        position = se3.transform(poses[number][0], seen.points[known])
        for axis, name in enumerate("xyz"):
            rows[name] = position[:, axis]
        colours = _colours(keyframe, seen)[known]
        for channel, name in enumerate(("blue", "green", "red")):
            rows[name] = colours[:, channel]
        yield rows


def _colours(keyframe: Keyframe, seen: Surface) -> NDArray[np.uint8]:
    """Return the mean colour (h * w, 3) BGR of the square of each pixel of the depth image."""
    h, w = seen.shape
    image: Any = None
    if keyframe.jpeg:
        image = cv2.imdecode(np.frombuffer(keyframe.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None or image.shape[0] < h * seen.block or image.shape[1] < w * seen.block:
        return np.full((h * w, 3), 128, np.uint8)
    small = cv2.resize(image[: h * seen.block, : w * seen.block], (w, h), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8).reshape(-1, 3)
