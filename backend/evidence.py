"""Why a candidate was taken for a loop or not: the matches, and every gate with its value and its limit."""

import json
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark.backend.epipolar import Direction
from seamark.backend.errors import MapCorruptError

VERSION = 1
DIRECTION_NUMBERS = 14  # R_match_query by rows, bearing, two deviations


@dataclass(frozen=True)
class Gate:
    """One test of a candidate: it passes where ``value`` is at least (``least``) or at most its ``limit``."""

    name: str
    value: float
    limit: float
    least: bool = True

    @property
    def passed(self) -> bool:
        """Return whether the candidate got through; a value that is not a number never does."""
        return self.value >= self.limit if self.least else self.value <= self.limit


@dataclass(frozen=True, eq=False)
class Evidence:
    """What two views have to say for and against showing one place.

    ``pixels`` (M, 4) float32 are the matches (x, y in the query, x, y in the match), as seen. ``inliers`` (M,) bool
    those that the geometry explains. ``missing`` (K, 2) float32 are pixels of the query where a landmark of the match
    should be and is not. ``gates`` come in the order in which they were tried, the last one failed or none did.
    ``direction`` is the pose up to its length, where epipolar geometry alone has spoken and holds it.
    """

    pixels: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    gates: tuple[Gate, ...] = ()
    reprojection_px: float = float("nan")
    missing: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    direction: Direction | None = None

    def gate(self, name: str) -> Gate | None:
        """Return the gate of this name, None where it was not tried."""
        return next((gate for gate in self.gates if gate.name == name), None)


def encode_evidence(evidence: Evidence) -> bytes:
    """Return the evidence as bytes; pixels are kept to 1/8 px."""
    facts = {
        "version": VERSION,
        "gates": [[gate.name, gate.value, gate.limit, gate.least] for gate in evidence.gates],
        "reprojection_px": evidence.reprojection_px,
        "matches": len(evidence.pixels),
        "missing": len(evidence.missing),
    }
    if evidence.direction is not None:
        facts["direction"] = _direction_as_numbers(evidence.direction)
    header = json.dumps(facts).encode() + b"\n"
    arrays = (_fixed_point(evidence.pixels), np.packbits(evidence.inliers), _fixed_point(evidence.missing))
    return zlib.compress(header + b"".join(array.tobytes() for array in arrays), 6)


def decode_evidence(blob: bytes) -> Evidence:
    """Return the evidence of :func:`encode_evidence`; raises MapCorruptError for anything else."""
    try:
        header, _, body = zlib.decompress(blob).partition(b"\n")
        facts = json.loads(header)
        if facts["version"] != VERSION:
            raise MapCorruptError(f"evidence of version {facts['version']}; this program knows {VERSION}")
        matches, missing = int(facts["matches"]), int(facts["missing"])
        ends = np.cumsum([16 * matches, (matches + 7) // 8, 8 * missing])
        if len(body) != ends[-1]:
            raise ValueError("length")
        pixels = np.frombuffer(body[: ends[0]], "<i4").reshape(-1, 4).astype(np.float32) / np.float32(8)
        inliers = np.unpackbits(np.frombuffer(body[ends[0] : ends[1]], np.uint8), count=matches).astype(bool)
        absent = np.frombuffer(body[ends[1] :], "<i4").reshape(-1, 2).astype(np.float32) / np.float32(8)
        gates = tuple(
            Gate(str(name), float(value), float(limit), bool(least)) for name, value, limit, least in facts["gates"]
        )
        direction = _direction_of_numbers(facts["direction"]) if "direction" in facts else None
        return Evidence(pixels, inliers, gates, float(facts["reprojection_px"]), absent, direction)
    except (zlib.error, ValueError, KeyError, TypeError) as error:
        raise MapCorruptError(f"the evidence of a loop is damaged: {error}") from error


def _direction_as_numbers(direction: Direction) -> list[float]:
    parts = direction.R_match_query.reshape(-1), direction.bearing
    return [*np.concatenate(parts).tolist(), direction.rotation_sigma, direction.bearing_sigma]


def _direction_of_numbers(numbers: list[float]) -> Direction:
    if len(numbers) != DIRECTION_NUMBERS:
        raise ValueError("direction")
    values = np.array(numbers, np.float64)
    return Direction(values[:9].reshape(3, 3), values[9:12], float(values[12]), float(values[13]))


def _fixed_point(pixels: NDArray[np.float32]) -> NDArray[np.int32]:
    return np.rint(8 * np.clip(pixels, -1e8, 1e8)).astype("<i4")
