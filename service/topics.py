"""The table of topics: every key expression that Seamark uses, who sends, who reads and how carefully.

Keys are ``seamark/v1/<namespace>/<suffix>``. Three kinds of topic exist. On an *acked* topic every reader named in the
table gets every message, in order, once, also when it was restarted in between; the key of one reader is
``<key>/<reader>``. On a *stream* the newest wins and nobody waits. A *request* is answered by its one reader.
"""

from dataclasses import dataclass
from enum import StrEnum

from seamark import SeamarkError
from seamark.backend.types import Loop, MapSnapshot
from seamark.frontend.types import Frame, Keyframe, Odometry
from seamark.service.requests import Done, Empty, Forget, PlaceQuery, PlaceReply, Status
from seamark.vocab.types import Candidates, PlaceObservation

ROOT = "seamark/v1"
FRONTEND, VOCAB, BACKEND = NODES = ("frontend", "vocab", "backend")
RUNNER = "runner"
ANYONE = "anyone"
_FORBIDDEN = set("*$?#/@")


class Kind(StrEnum):
    """How a topic is delivered."""

    ACKED = "acked"
    STREAM = "stream"
    REQUEST = "request"


class Reliability(StrEnum):
    """What Zenoh is asked for on the link."""

    RELIABLE = "reliable"
    BEST_EFFORT = "best_effort"


class Congestion(StrEnum):
    """What happens to a message when the link is full."""

    BLOCK = "block"
    DROP = "drop"


class NamespaceError(SeamarkError):
    """A namespace cannot be part of a key expression."""


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    ``depth`` is, for an acked topic, how many messages may be unacknowledged before the sender waits; for a stream, how
    many a slow reader keeps; for a request, how many may wait before the next is refused as busy. ``recorded`` says
    whether a recording of the service contains it. ``timeout_s`` is how long a request waits unless told otherwise.
    """

    name: str
    suffix: str
    kind: Kind
    message: type
    producer: str
    readers: tuple[str, ...]
    depth: int
    description: str
    reply: type | None = None
    reliability: Reliability = Reliability.RELIABLE
    congestion: Congestion = Congestion.BLOCK
    recorded: bool = False
    timeout_s: float = 10.0

    def key(self, namespace: str, reader: str | None = None) -> str:
        """Return the key expression, of one reader of an acked topic if given; raises NamespaceError."""
        prefix = f"{ROOT}/{checked_namespace(namespace)}/{self.suffix}"
        return prefix if reader is None else f"{prefix}/{reader}"


def checked_namespace(namespace: str) -> str:
    """Return the namespace, one plain chunk of a key expression; raises NamespaceError for anything else."""
    if not namespace or _FORBIDDEN & set(namespace):
        raise NamespaceError(f"namespace {namespace!r} must be one word without any of * $ ? # / @")
    return namespace


def live_key(namespace: str, node: str) -> str:
    """Return the key of a node's liveliness token (``@``: no other expression matches it by accident)."""
    return f"{ROOT}/{checked_namespace(namespace)}/@live/{node}"


def _stream(name: str, message: type, producer: str, depth: int, description: str, recorded: bool = False) -> Topic:
    return Topic(
        name,
        name,
        Kind.STREAM,
        message,
        producer,
        (ANYONE,),
        depth,
        description,
        reliability=Reliability.BEST_EFFORT,
        congestion=Congestion.DROP,
        recorded=recorded,
    )


FRAME = Topic(
    "frame",
    "frame",
    Kind.REQUEST,
    Frame,
    RUNNER,
    (FRONTEND,),
    16,
    "One frame to process, in order and without loss; answered with its odometry.",
    reply=Odometry,
    recorded=True,
    timeout_s=300.0,  # a back end that is slower than the frames holds them up, and that is meant
)
KEYFRAME = Topic(
    "keyframe",
    "keyframe",
    Kind.ACKED,
    Keyframe,
    FRONTEND,
    (VOCAB, BACKEND),
    16,
    "A frame that the map remembers; acknowledged by the back end once it is on disk.",
    recorded=True,
)
CANDIDATES = Topic(
    "candidates",
    "candidates",
    Kind.ACKED,
    Candidates,
    VOCAB,
    (BACKEND,),
    16,
    "The ranked places for one keyframe; acknowledged once verified and in the map.",
    recorded=True,
)
FORGET = Topic(
    "forget",
    "forget",
    Kind.ACKED,
    Forget,
    BACKEND,
    (VOCAB,),
    16,
    "Views that the map has given up for its budget; acknowledged once they are no places any more.",
    recorded=True,
)
CAMERA = Topic(
    "camera",
    "camera",
    Kind.STREAM,
    Frame,
    ANYONE,
    (FRONTEND,),
    1,
    "Frames of a live camera; the newest wins and drops are counted.",
    reliability=Reliability.BEST_EFFORT,
    congestion=Congestion.DROP,
)
ODOMETRY = _stream("odometry", Odometry, FRONTEND, 8, "What the front end says of every frame.", recorded=True)
LOOP = _stream("loop", Loop, BACKEND, 256, "The verdict on every place candidate that was tried.", recorded=True)
MAP = _stream("map", MapSnapshot, BACKEND, 1, "The map after every optimisation.")
MAP_SNAPSHOT = Topic(
    "map_snapshot",
    "map/snapshot",
    Kind.REQUEST,
    Empty,
    ANYONE,
    (BACKEND,),
    4,
    "The map as it is now.",
    reply=MapSnapshot,
)
PLACES_RANK = Topic(
    "places_rank",
    "places/rank",
    Kind.REQUEST,
    PlaceObservation,
    BACKEND,
    (VOCAB,),
    8,
    "Ranks all places for a query image and adds nothing.",
    reply=Candidates,
)
PLACE = Topic(
    "place",
    "place",
    Kind.REQUEST,
    PlaceQuery,
    ANYONE,
    (BACKEND,),
    4,
    "Have I been here, and where am I? JPEG or PNG bytes in, ranked and verified places out.",
    reply=PlaceReply,
    timeout_s=30.0,
)
DRAIN = {
    node: Topic(
        f"drain_{node}",
        f"drain/{node}",
        Kind.REQUEST,
        Empty,
        RUNNER,
        (node,),
        2,
        f"Answered when the {node} node has nothing left to do and all it sent is acknowledged.",
        reply=Done,
        timeout_s=600.0,
    )
    for node in NODES
}
STATUS = {
    node: Topic(
        f"status_{node}",
        f"status/{node}",
        Kind.REQUEST,
        Empty,
        ANYONE,
        (node,),
        4,
        f"Counters, memory, CPU time and latencies per stage of the {node} node.",
        reply=Status,
    )
    for node in NODES
}

PROGRESS = {
    node: Topic(
        f"progress_{node}",
        f"progress/{node}",
        Kind.REQUEST,
        Empty,
        RUNNER,
        (node,),
        2,
        f"As status, but answered by the {node} node only after all that was sent to it before.",
        reply=Status,
        timeout_s=60.0,
    )
    for node in (VOCAB, BACKEND)
}

STOPPING = Topic(
    "stopping",
    "stopping/backend",
    Kind.REQUEST,
    Empty,
    RUNNER,
    (BACKEND,),
    2,
    "The service stops: for ten seconds keyframes are stored at once, and mapped after the next start.",
    reply=Done,
    timeout_s=2.0,
)

#: All topics, in the order of the documentation.
TOPICS: tuple[Topic, ...] = (
    FRAME,
    CAMERA,
    ODOMETRY,
    KEYFRAME,
    CANDIDATES,
    FORGET,
    LOOP,
    MAP,
    MAP_SNAPSHOT,
    PLACE,
    PLACES_RANK,
    *DRAIN.values(),
    *STATUS.values(),
    *PROGRESS.values(),
    STOPPING,
)


def markdown_table() -> str:
    """Return the table of topics in Markdown, for docs/api.md."""
    lines = [
        "| key | kind | message -> reply | from | to | reliability | when full | depth | recorded | meaning |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS:
        key = topic.key("NAMESPACE") + ("/READER" if topic.kind is Kind.ACKED else "")
        content = topic.message.__name__ + (f" -> {topic.reply.__name__}" if topic.reply else "")
        readers, recorded = ", ".join(topic.readers), "yes" if topic.recorded else "no"
        lines.append(
            f"| `{key}` | {topic.kind} | {content} | {topic.producer} | {readers} | {topic.reliability} |"
            f" {topic.congestion} | {topic.depth} | {recorded} | {topic.description} |"
        )
    return "\n".join(lines) + "\n"
