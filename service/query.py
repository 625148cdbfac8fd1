"""`seamark query`: one image to a running service, its answer back."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from seamark import SeamarkError
from seamark.service import topics
from seamark.service.directions import describe_direction, direction_as_json
from seamark.service.requests import PlaceQuery, PlaceReply
from seamark.service.results import pose_fields
from seamark.service.stamps import format_stamp
from seamark.service.zenoh_bus import ZenohBus
from seamark.service.zenoh_session import CLIENT_CONNECT_TIMEOUT_S, open_session
from seamark.vocab.confidence import Verdict


class QueryError(SeamarkError):
    """The service could not answer; the text is its own."""


def ask(image: Path, *, endpoint: str, namespace: str, top_k: int, timeout_s: float) -> PlaceReply:
    """Send an image file as a place query; raises QueryError, BusError or a file error as SeamarkError."""
    try:
        content = image.read_bytes()
    except OSError as error:
        raise QueryError(f"{image} cannot be read: {error.strerror}") from error
    with open_session("client", connect=[endpoint], timeout_s=min(timeout_s, CLIENT_CONNECT_TIMEOUT_S)) as session:
        bus = ZenohBus(session, topics.ANYONE, namespace)
        try:
            reply: PlaceReply = bus.request(topics.PLACE, PlaceQuery(content, top_k), timeout_s)
        finally:
            bus.close()
    return reply


def as_json(reply: PlaceReply) -> dict[str, Any]:
    """Return the answer as plain values: ``places`` ranked from 1, or ``error`` with code and message."""
    error = None
    if reply.error_code is not None:
        error = {"code": str(reply.error_code), "message": reply.error_message}
    places = []
    for rank, place in enumerate(reply.places, start=1):
        row = asdict(place)
        pose = pose_fields(place.T_map_cam) if place.T_map_cam is not None else None
        row |= {
            "rank": rank,
            "stamp": format_stamp(place.stamp_ns),
            "reason": str(place.reason),
            "T_map_cam": dict(zip(("tx", "ty", "tz", "qx", "qy", "qz", "qw"), map(float, pose), strict=True))
            if pose
            else None,
            "direction": None if place.direction is None else direction_as_json(place.direction),
        }
        del row["stamp_ns"]
        places.append(row)
    verdict = None if reply.verdict is None else str(reply.verdict)
    return {"places": places, "verdict": verdict, "error": error, "timings_ms": reply.timings_ms}


def table(reply: PlaceReply) -> Table:
    """Return the answer as a table for the terminal."""
    said = "" if reply.verdict is None else f" {'yes' if reply.verdict == Verdict.ACCEPTED else reply.verdict}"
    out = Table(title=f"Have I been here?{said}")
    for column in ("rank", "file", "stamp", "score", "votes", "jeffrey", "inliers", "verdict", "position in the map"):
        out.add_column(column)
    for rank, place in enumerate(reply.places, start=1):
        position = "" if place.direction is None else describe_direction(place.direction)
        if place.T_map_cam is not None:
            position = "{:.3f} {:.3f} {:.3f}".format(*place.T_map_cam[:3, 3])
        verdict = "yes" if place.accepted else str(place.reason)
        out.add_row(
            str(rank),
            place.file,
            format_stamp(place.stamp_ns),
            f"{place.score:.4f}",
            f"{place.votes:.4f}",
            f"{place.jeffrey:.4f}",
            str(place.inliers),
            verdict,
            position,
        )
    return out
