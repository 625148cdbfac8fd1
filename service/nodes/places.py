"""Answers to "have I been here, and where am I?"."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from seamark.backend.types import Place
from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import extract_features, thumbnail_of
from seamark.frontend.types import Keyframe
from seamark.service.requests import PlaceError, PlaceQuery, PlaceReply
from seamark.service.sources.decode import UnreadableImageError, decode, to_image
from seamark.vocab.confidence import MIN_INLIERS, Verdict
from seamark.vocab.types import Candidates, PlaceObservation

QUERY_ID = -1
RIVAL_SHARE = 0.5  # of the inliers of the first place: a place with so many is about as good
ELSEWHERE_M, ELSEWHERE_DEG = 3.0, 30.0  # a map without scale has units of its own in place of metres


class PlaceService:
    """Describes a query image, has it ranked, and has the best verified against the map.

    ``rank`` asks the vocabulary, ``locate`` the back end; both must be safe to call from several threads. ``camera`` is
    taken for images of its size that come without one.
    """

    def __init__(
        self,
        config: FrontendConfig,
        camera: Camera | None,
        rank: Callable[[PlaceObservation], Candidates],
        locate: Callable[[Keyframe, Candidates], tuple[Place, ...]],
    ) -> None:
        self._config = config
        self._camera = camera
        self._rank = rank
        self._locate = locate

    def answer(self, query: PlaceQuery) -> PlaceReply:
        """Answer one query; what is wrong with the query itself is part of the answer."""
        timings_ms: dict[str, float] = {}
        start = time.perf_counter()

        def lap(stage: str) -> None:
            nonlocal start
            now = time.perf_counter()
            timings_ms[stage] = 1e3 * (now - start)
            start = now

        try:
            image = to_image(decode(query.image, "the query image"), "the query image")
        except UnreadableImageError as error:
            return PlaceReply((), PlaceError.UNDECODABLE_IMAGE, str(error), verdict=Verdict.UNREADABLE)
        camera = query.camera
        if camera is not None and (camera.height, camera.width) != image.shape[:2]:
            size = f"{image.shape[1]} x {image.shape[0]}"
            message = f"the camera is for {camera.width} x {camera.height} pixels, the image has {size}"
            return PlaceReply((), PlaceError.BAD_REQUEST, message)
        lap("decode")
        keyframe = self._describe(query, image, camera)
        lap("features")
        if len(keyframe.features) == 0:
            message = "nothing in the query image can be recognised: it has no features"
            return PlaceReply((), PlaceError.NO_FEATURES, message, timings_ms, Verdict.NO_FEATURES)
        candidates = self._rank(_observe(keyframe))
        lap("rank")
        if not candidates.ranked:
            return PlaceReply((), PlaceError.EMPTY_MAP, "the map has no places yet", timings_ms, Verdict.EMPTY)
        places = self._locate(keyframe, candidates)
        lap("locate")
        return PlaceReply(places[: query.top_k], timings_ms=timings_ms, verdict=judge(places))

    def _describe(self, query: PlaceQuery, image: NDArray[np.uint8], camera: Camera | None) -> Keyframe:
        own = self._camera
        if camera is None and own is not None and (own.height, own.width) == image.shape[:2]:
            camera = own
        c = self._config
        features = extract_features(image, c.sift_features, c.sift_contrast, max_pixels=c.sift_pixels)
        return Keyframe(
            id=QUERY_ID,
            session=QUERY_ID,
            index=QUERY_ID,
            stamp_ns=0,
            file="",
            features=features,
            landmarks=np.full((len(features), 3), np.nan, np.float32),
            thumbnail=thumbnail_of(image, c.thumbnail_px),
            jpeg=query.image,
            camera=camera,
        )


def judge(places: Sequence[Place]) -> Verdict:
    """Return what became of a query whose places, best first, have been verified.

    Places that geometry confirms about as well as the first must put the camera where that puts it, else there are two
    that look alike, and the answer is doubt.
    """
    accepted = [place for place in places if place.accepted]
    if not accepted:
        most = max((place.inliers for place in places), default=0)
        return Verdict.FEW_INLIERS if most < MIN_INLIERS else Verdict.UNSURE
    rivals = [place for place in accepted[1:] if place.inliers >= RIVAL_SHARE * accepted[0].inliers]
    return Verdict.DOUBT if any(_elsewhere(accepted[0], rival) for rival in rivals) else Verdict.ACCEPTED


def _elsewhere(one: Place, other: Place) -> bool:
    if one.T_map_cam is None or other.T_map_cam is None:
        return False
    distance = float(np.linalg.norm(one.T_map_cam[:3, 3] - other.T_map_cam[:3, 3]))
    turn = float(np.rad2deg(se3.rotation_angle(one.T_map_cam[:3, :3].T @ other.T_map_cam[:3, :3])))
    return distance > ELSEWHERE_M or turn > ELSEWHERE_DEG


def _observe(keyframe: Keyframe) -> PlaceObservation:
    features = keyframe.features
    return PlaceObservation(
        QUERY_ID,
        QUERY_ID,
        keyframe.stamp_ns,
        features.descriptors,
        features.points,
        keyframe.thumbnail,
        features.scales,
        features.angles,
    )
