"""Which candidates a keyframe or an image is compared with, and what comes of each."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from seamark.backend.align_surfaces import aligned
from seamark.backend.config import BackendConfig, VerificationConfig
from seamark.backend.far_landmarks import Landmarks, measured_landmarks, with_far_landmarks
from seamark.backend.likelihood import probability
from seamark.backend.map_memory import KeyframeMemory
from seamark.backend.types import Place, Reason
from seamark.backend.verify import Rejected, Verification, pair_seed, verify
from seamark.frontend.types import Keyframe, Mode
from seamark.vocab.types import Candidate, Candidates

Matrix = NDArray[np.float64]
Verified = list[tuple[Candidate, Verification | Rejected]]
FAR_KEPT = 256  # keyframes, some 30 kB each
PoseOfNeighbour = Callable[[int, Matrix], Matrix | None]  # T_map_cam of a camera from T_keyframe_cam


class FarLandmarkCache:
    """Landmarks of keyframes beyond the reach of their sensors, from neighbours in the map; the last used are kept.

    May be shared by threads.
    """

    def __init__(self, config: VerificationConfig, memory: KeyframeMemory) -> None:
        self._config, self._memory = config, memory
        self._kept: OrderedDict[tuple[int, ...], Landmarks] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, keyframe: Keyframe, known: Mapping[int, Keyframe]) -> Landmarks:
        """Return the landmarks of a keyframe with its features; ``known`` are the keyframes of the map by id."""
        if keyframe.T_odom_cam is None:
            return measured_landmarks(keyframe)
        before = None if keyframe.previous_id is None else known.get(keyframe.previous_id)
        after = known.get(keyframe.id + 1)
        neighbours = [] if before is None else [before]
        if after is not None and after.previous_id == keyframe.id:
            neighbours.append(after)
        key = (keyframe.id, *(one.id for one in neighbours))
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        found = with_far_landmarks(keyframe, [self._memory.whole(one) for one in neighbours], self._config)
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > FAR_KEPT:
                self._kept.popitem(last=False)
        return found


class CandidateVerifier:
    """Compares by geometry with one candidate per island of neighbouring keyframes, the best first.

    In mode places, which knows no poses, every image is a place of its own. ``known`` are the keyframes of the map by
    id; their features come from ``memory``. May be shared by threads.
    """

    def __init__(self, config: BackendConfig, mode: Mode, seed: int, memory: KeyframeMemory) -> None:
        self._config, self._places, self._seed, self._memory = config, mode == Mode.PLACES, seed, memory
        self._far = FarLandmarkCache(config.verification, memory)

    def of_keyframe(self, keyframe: Keyframe, candidates: Candidates, known: Mapping[int, Keyframe]) -> Verified:
        """Return what geometry says of a keyframe's candidates; the recent past is none."""
        verified = [
            (candidate, self._compare(keyframe, self._memory.whole(known[candidate.id]), known))
            for candidate in self._islands(candidates, known, keyframe)
        ]
        return self._best_of_islands(verified) if self._places else verified

    def of_image(
        self, query: Keyframe, candidates: Candidates, known: Mapping[int, Keyframe], pose_of: PoseOfNeighbour
    ) -> tuple[Place, ...]:
        """Return what geometry says of an image's candidates: localised ones first, then by inliers."""
        places = [self._place(query, candidate, known, pose_of) for candidate in self._islands(candidates, known, None)]
        return tuple(sorted(places, key=lambda place: (not place.accepted, -place.inliers)))

    def _compare(self, query: Keyframe, match: Keyframe, known: Mapping[int, Keyframe]) -> Verification | Rejected:
        seed = pair_seed(self._seed, query.id, match.id)
        found = verify(query, match, self._config.verification, seed, lambda keyframe: self._far.of(keyframe, known))
        return aligned(found, query, match, self._config.alignment)

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

    def _place(
        self, query: Keyframe, candidate: Candidate, known: Mapping[int, Keyframe], pose_of: PoseOfNeighbour
    ) -> Place:
        """Say what the comparison of a query image with one keyframe means."""
        match = self._memory.whole(known[candidate.id])
        result = self._compare(query, match, known)
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
            direction=result.direction if isinstance(result, Verification) else None,
        )
