"""Messages that belong to no other room: encoded frames, questions to the service and their answers."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from seamark.backend.types import Place
from seamark.frontend.types import Camera
from seamark.vocab.confidence import Verdict

Picture = bytes | NDArray[np.uint8]
DepthPicture = bytes | NDArray[np.uint16] | NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """A :class:`seamark.frontend.types.Frame` of which at least one picture is still JPEG or PNG bytes.

    ``image``, ``image_right`` and ``mask`` are bytes or the arrays of Frame; ``depth`` is a 16-bit PNG or its array.
    """

    index: int
    stamp_ns: int
    image: Picture
    image_right: Picture | None = None
    depth: DepthPicture | None = None
    file: str = ""
    mask: Picture | None = None


class PlaceError(StrEnum):
    """Why a place query has no answer at all; "not recognised" is an answer and no error."""

    UNDECODABLE_IMAGE = "undecodable_image"
    NO_FEATURES = "no_features"
    EMPTY_MAP = "empty_map"
    BAD_REQUEST = "bad_request"


@dataclass(frozen=True, eq=False)
class PlaceQuery:
    """The question "have I been here, and where am I?".

    ``image`` is a JPEG or PNG file; ``top_k`` in 1..1000 bounds the answer; ``camera`` is that of the image when it is
    not the service's own.
    """

    image: bytes
    top_k: int = 10
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class PlaceReply:
    """Ranked places, best first, or a typed error; ``timings_ms`` per stage of the answer.

    ``verdict`` says whether the first place is the answer, or why the answer is "nothing here"; None where the query
    was no question, or the service is older than verdicts.
    """

    places: tuple[Place, ...] = ()
    error_code: PlaceError | None = None
    error_message: str = ""
    timings_ms: dict[str, float] = field(default_factory=dict)
    verdict: Verdict | None = None


@dataclass(frozen=True)
class Empty:
    """A request without content."""


@dataclass(frozen=True)
class Done:
    """``node`` has done what was asked."""

    node: str


@dataclass(frozen=True, eq=False)
class Status:
    """What one node has done and used.

    ``rss_bytes`` and ``peak_rss_bytes`` are of the node's process and the largest of its children together, ``cpu_s``
    is user and system time with children; ``stages_ms`` maps a stage of the work to its latest latencies in ms.
    """

    node: str
    pid: int
    rss_bytes: int
    peak_rss_bytes: int
    cpu_s: float
    counters: dict[str, int] = field(default_factory=dict)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Forget:
    """Keyframes (N,) int64 whose views the map has given up: they are no places any more."""

    keyframe_ids: NDArray[np.int64]
