"""All that a map knows of one loop: what it rests on, what became of it, and how far the map believes it today."""

from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from seamark.backend.align_surfaces import aligned
from seamark.backend.config import BackendConfig, VerificationConfig
from seamark.backend.errors import MapError
from seamark.backend.evidence import Evidence
from seamark.backend.far_landmarks import Landmarks, with_far_landmarks
from seamark.backend.map_reader import Verdict
from seamark.backend.map_store import MapStore
from seamark.backend.types import Loop
from seamark.backend.verify import pair_seed, verify
from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]


class Source(StrEnum):
    """Where the evidence of an explanation comes from."""

    STORED = "stored"
    RECOMPUTED = "recomputed"  # from the features in the map, with today's settings
    LOST = "lost"  # neither evidence nor features are left


@dataclass(frozen=True, eq=False)
class Explanation:
    """A loop with its two keyframes (images included), evidence and history.

    ``error`` (6,) is how far the map's poses are from the loop, in standard deviations' own units: rotation (rad), then
    translation in the query's units, and ``chi2`` the same weighed; ``weight`` is what the robust kernel leaves of the
    loop, 0..1. None of the three where the loop has no pose, or the map none for its keyframes.
    """

    loop: Loop
    query: Keyframe
    match: Keyframe
    evidence: Evidence | None
    source: Source
    history: tuple[Verdict, ...]
    error: NDArray[np.float64] | None = None
    chi2: float | None = None
    weight: float | None = None


def parse_loop_id(text: str, loops: tuple[Loop, ...]) -> Loop:
    """Return the loop that ``QUERY-MATCH``, or the number of a query keyframe with one loop alone, stands for.

    Raises MapError, naming what there is, when that is none or more than one.
    """
    numbers = [int(part) for part in text.replace(":", "-").replace(",", "-").split("-") if part.strip().isdecimal()]
    found = [x for x in loops if numbers in ([x.query_id, x.match_id], [x.query_id])]
    if len(found) > 1:
        accepted = [x for x in found if x.accepted]
        found = accepted if len(accepted) == 1 else found
    if len(found) == 1:
        return found[0]
    if not found:
        raise MapError(f"the map has no loop {text}; a loop is named QUERY-MATCH, as in its list")
    raise MapError(f"keyframe {text} has loops {', '.join(f'{x.query_id}-{x.match_id}' for x in found)}: name one")


def explain(store: MapStore, loop: Loop, config: BackendConfig, seed: int) -> Explanation:
    """Collect what the map has on a loop; evidence that was not kept is worked out again where features are left."""
    query, match = store.keyframe(loop.query_id), store.keyframe(loop.match_id)
    evidence, source = store.evidence(loop.query_id, loop.match_id), Source.STORED
    if evidence is None and len(query.features) and len(match.features):
        far = partial(_far_landmarks, store=store, config=config.verification)
        result = verify(query, match, config.verification, pair_seed(seed, query.id, match.id), far)
        result = aligned(result, query, match, config.alignment)
        evidence, source = result.evidence, Source.RECOMPUTED
    if evidence is None:
        source = Source.LOST
    error, chi2, weight = disagreement(loop, store, config.graph.cauchy_width)
    history = store.history(loop.query_id, loop.match_id)
    return Explanation(loop, query, match, evidence, source, history, error, chi2, weight)


def _far_landmarks(keyframe: Keyframe, store: MapStore, config: VerificationConfig) -> Landmarks:
    """Return the landmarks of a keyframe and those that its neighbours in the map add."""
    neighbours = []
    for number in (keyframe.previous_id, keyframe.id + 1):
        with suppress(MapError):
            neighbours += [] if number is None else [store.keyframe(number)]
    beside = (one for one in neighbours if keyframe.id == one.previous_id or one.id == keyframe.previous_id)
    return with_far_landmarks(keyframe, list(beside), config)


def disagreement(
    loop: Loop, store: MapStore, width: float
) -> tuple[NDArray[np.float64] | None, float | None, float | None]:
    """Return how far the map's poses are from a loop, its chi squared, and the weight of Cauchy's kernel for it."""
    poses = store.load_poses()
    at_match, at_query = poses.get(loop.match_id), poses.get(loop.query_id)
    if loop.T_match_query is None or loop.covariance is None or at_match is None or at_query is None:
        return None, None, None
    (T_map_match, component, scale), (T_map_query, other, _) = at_match, at_query
    if T_map_match is None or T_map_query is None or component != other:
        return None, None, None
    T = se3.inverse(T_map_match) @ T_map_query
    T[:3, 3] /= scale  # to the match's units
    E = se3.inverse(loop.T_match_query) @ T
    error = np.concatenate([se3.log_rotation(E[:3, :3]), E[:3, 3] / loop.scale])
    chi2 = float(error @ np.linalg.solve(loop.covariance, error))
    return error, chi2, (1.0 / (1.0 + chi2 / width**2) if loop.accepted else 0.0)
