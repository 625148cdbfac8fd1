"""Which candidates a keyframe or an image is compared with, and what comes of each."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import BackendConfig
from seamark.backend.likelihood import probability
from seamark.backend.map_memory import KeyframeMemory
from seamark.backend.types import Place, Reason
from seamark.backend.verify import Rejected, Verification, pair_seed, verify
from seamark.frontend.types import Keyframe, Mode
from seamark.vocab.types import Candidate, Candidates

Matrix = NDArray[np.float64]
Verified = list[tuple[Candidate, Verification | Rejected]]
PoseOfNeighbour = Callable[[int, Matrix], Matrix | None]  # T_map_cam of a camera from T_keyframe_cam


class CandidateVerifier:
    """Compares by geometry with one candidate per island of neighbouring keyframes, the best first.

    In mode places, which knows no poses, every image is a place of its own. ``known`` are the keyframes of the map by
    id; their features come from ``memory``. May be shared by threads.
    """

    def __init__(self, config: BackendConfig, mode: Mode, seed: int, memory: KeyframeMemory) -> None:
        self._config, self._places, self._seed, self._memory = config, mode == Mode.PLACES, seed, memory

    def of_keyframe(self, keyframe: Keyframe, candidates: Candidates, known: Mapping[int, Keyframe]) -> Verified:
        """Return what geometry says of a keyframe's candidates; the recent past is none."""
        verified = [
            (candidate, self._compare(keyframe, self._memory.whole(known[candidate.id])))
            for candidate in self._islands(candidates, known, keyframe)
        ]
        return self._best_of_islands(verified) if self._places else verified

    def of_image(
        self, query: Keyframe, candidates: Candidates, known: Mapping[int, Keyframe], pose_of: PoseOfNeighbour
    ) -> tuple[Place, ...]:
        """Return what geometry says of an image's candidates: localised ones first, then by inliers."""
        places = [
            self._place(query, candidate, self._memory.whole(known[candidate.id]), pose_of)
            for candidate in self._islands(candidates, known, None)
        ]
        return tuple(sorted(places, key=lambda place: (not place.accepted, -place.inliers)))

    def _compare(self, query: Keyframe, match: Keyframe) -> Verification | Rejected:
        return verify(query, match, self._config.verification, pair_seed(self._seed, query.id, match.id))

    def _islands(
        self, candidates: Candidates, known: Mapping[int, Keyframe], keyframe: Keyframe | None
    ) -> list[Candidate]:
        """Return the best candidate of each island of neighbouring keyframes; the recent past is none."""
        config = self._config.verification
        count, radius = config.candidates, config.island_keyframes
        if self._places:  # a place is an image: all are compared, see _best_of_islands
            count, radius = self._config.places.candidates, 0
        chosen: list[Candidate] = []
        for candidate in candidates.ranked:
            match = known.get(candidate.id)
            if match is None or (keyframe is not None and match.id == keyframe.id):
                continue
            recent = keyframe is not None and keyframe.session == match.session
            if recent and keyframe is not None and abs(keyframe.id - match.id) < config.min_gap_keyframes:
                continue
            near = (abs(other.id - match.id) <= radius and known[other.id].session == match.session for other in chosen)
            if not any(near):
                chosen.append(candidate)
            if len(chosen) == count:
                break
        return chosen

    def _best_of_islands(self, verified: Verified) -> Verified:
        """Without poses a place is the image nearest to where the query was taken: its neighbours, which see much
        the same with fewer inliers, are refused as INCONSISTENT with it.
        """
        radius = self._config.places.island_images
        best: list[int] = []
        for candidate, result in sorted(verified, key=lambda pair: -pair[1].inliers):
            if isinstance(result, Verification) and all(abs(candidate.id - other) > radius for other in best):
                best.append(candidate.id)
        return [
            (candidate, result)
            if isinstance(result, Rejected) or candidate.id in best
            else (candidate, Rejected(Reason.INCONSISTENT, result.inliers, result.matches))
            for candidate, result in verified
        ]

    def _place(self, query: Keyframe, candidate: Candidate, match: Keyframe, pose_of: PoseOfNeighbour) -> Place:
        """Say what the comparison of a query image with one keyframe means."""
        result = self._compare(query, match)
        reason, T_map_cam = Reason.ACCEPTED, None
        if isinstance(result, Rejected):
            reason = result.reason
        elif result.inliers < self._config.verification.locate_inliers:
            reason = Reason.UNCONFIRMED
        elif result.T_match_query is not None:
            T_map_cam = pose_of(match.id, result.T_match_query)
        return Place(
            keyframe_id=match.id,
            session=match.session,
            stamp_ns=match.stamp_ns,
            file=match.file,
            score=candidate.score,
            votes=candidate.votes,
            jeffrey=candidate.jeffrey,
            inliers=result.inliers,
            accepted=reason == Reason.ACCEPTED,
            reason=reason,
            T_map_cam=T_map_cam,
            view=candidate.view,
            probability=probability(query, match, candidate.score),
        )
