"""What a keyframe carries beyond its pose: SIFT, landmarks, JPEG, thumbnail; made in a thread beside tracking.

SIFT costs as much as three frames of tracking and frees the interpreter while it works, so one plain thread keeps it
off the frame's latency. While a frame is tracked its kernel stands still, as long as it keeps up: a pose is waited
for, key points are not. Keyframes come out in the order they went in; nothing that the tracker decides depends on when.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import DepthSensor
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.features import extract_features, match_descriptors, thumbnail_of
from seamark.frontend.kernels import native
from seamark.frontend.keyframe_depth import NOTHING, encode_depth
from seamark.frontend.two_view import triangulate
from seamark.frontend.types import Features, Frame, Keyframe, Mode, Rig

MAX_PENDING = 8
UNHURRIED = 4  # with more under way the thread has fallen behind, and gives way no longer
TRIANGULATION_PX = 2.0
NO_OFFSET = DepthOffset.expected(0.0)
RELATIVE_SIGMA = 0.2  # a landmark whose depth is less sure than this is not worth keeping


@dataclass(frozen=True, eq=False)
class KeyframeRequest:
    """A decided keyframe whose content is still to be made; fields as in Keyframe."""

    frame: Frame
    id: int
    session: int
    previous_id: int | None
    T_odom_cam: NDArray[np.float64] | None
    covariance: NDArray[np.float64] | None
    depth_offset: DepthOffset


class KeyframeBuilder:
    """Turns requests into keyframes, in order, in one thread."""

    def __init__(self, rig: Rig | None, mode: Mode, config: FrontendConfig, sensor: DepthSensor) -> None:
        self._rig, self._mode, self._config, self._sensor = rig, mode, config, sensor
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="keyframes")
        self.way = native.RightOfWay()
        self._pending: deque[Future[list[Keyframe]]] = deque()
        self._ready: list[Keyframe] = []
        self._recent: deque[Keyframe] = deque(maxlen=config.recovery_keyframes)
        self.next_id = 0
        self._last_made: Keyframe | None = None  # touched by the pool's thread only

    def request(
        self,
        frame: Frame,
        session: int,
        previous_id: int | None = None,
        T_odom_cam: NDArray[np.float64] | None = None,
        covariance: NDArray[np.float64] | None = None,
        depth_offset: DepthOffset = NO_OFFSET,
    ) -> KeyframeRequest:
        """Number a decided keyframe; it is made once it is submitted."""
        request = KeyframeRequest(frame, self.next_id, session, previous_id, T_odom_cam, covariance, depth_offset)
        self.next_id += 1
        return request

    def submit(self, requests: Sequence[KeyframeRequest]) -> None:
        """Queue requests that belong together: two for the first map of a mono session, else one.

        Waits for the oldest when MAX_PENDING are under way: images in a queue are memory without bound.
        """
        while len(self._pending) >= MAX_PENDING:
            self._collect()
        self._pending.append(self._pool.submit(self._make_all, list(requests)))

    @contextmanager
    def tracking(self) -> Iterator[None]:
        """Have the right of way over the thread, unless it has fallen behind."""
        if sum(not made.done() for made in self._pending) <= UNHURRIED:
            self.way.take()
        try:
            yield
        finally:
            self.way.give_back()

    def take(self) -> tuple[Keyframe, ...]:
        """Hand out the keyframes that are ready, without waiting."""
        while self._pending and self._pending[0].done():
            self._collect()
        ready, self._ready = tuple(self._ready), []
        return ready

    def wait(self) -> None:
        """Wait until every submitted keyframe is ready."""
        while self._pending:
            self._collect()

    def recent(self, session: int) -> list[Keyframe]:
        """Wait, then return the last keyframes of a session, newest first."""
        self.wait()
        return [k for k in reversed(self._recent) if k.session == session]

    def close(self) -> None:
        """Stop the thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _collect(self) -> None:
        self.way.give_back()  # who waits for the thread does not hold it up
        keyframes = self._pending.popleft().result()
        self._recent.extend(keyframes)
        self._ready.extend(keyframes)

    def _make_all(self, requests: list[KeyframeRequest]) -> list[Keyframe]:
        made: list[Keyframe] = []
        for request in requests:
            keyframe = self._make(request)
            before = made[-1] if made else self._last_made
            if self._mode is Mode.MONO and before is not None and before.session == keyframe.session:
                first, keyframe = triangulate_pair(before, keyframe, self._config)
                if made:
                    made[-1] = first
            made.append(keyframe)
            self._last_made = keyframe
        return made

    def _make(self, request: KeyframeRequest) -> Keyframe:
        frame, c = request.frame, self._config
        features = extract_features(frame.image, c.sift_features, c.sift_contrast, frame.mask, c.sift_pixels, self.way)
        ok, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, c.jpeg_quality])
        assert ok, "an 8-bit image can be encoded"
        return Keyframe(
            id=request.id,
            session=request.session,
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            file=frame.file,
            features=features,
            landmarks=self._landmarks(frame, features, request.depth_offset),
            thumbnail=thumbnail_of(frame.image, c.thumbnail_px),
            jpeg=jpeg.tobytes(),
            camera=self._camera_of(frame),
            previous_id=request.previous_id,
            T_odom_cam=request.T_odom_cam,
            covariance=request.covariance,
            metric=self._mode is not Mode.MONO,
            depth=self._depth_of(frame),
        )

    def _depth_of(self, frame: Frame) -> bytes:
        """Return the small depth image of a frame of a depth camera, nothing of others."""
        if self._mode is not Mode.RGBD or self._rig is None or frame.depth is None:
            return NOTHING
        return encode_depth(frame.depth, self._rig.depth_factor, self._config, frame.mask)

    def _camera_of(self, frame: Frame) -> Camera | None:
        """Return the calibration if it is for images of this size: in mode places there may be others."""
        camera = None if self._rig is None else self._rig.cam0
        return camera if camera is not None and (camera.height, camera.width) == frame.image.shape[:2] else None

    def _landmarks(self, frame: Frame, features: Features, offset: DepthOffset) -> NDArray[np.float32]:
        unknown = np.full((len(features), 3), np.nan, np.float32)
        if self._rig is None or len(features) == 0:
            return unknown
        inverse, sigma = self._sensor.inverse_depth(frame, features.points)
        inverse = offset.correct(inverse)
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = np.where(sigma < RELATIVE_SIGMA * inverse, 1 / inverse, np.nan)
        return (self._rig.cam0.rays(features.points) * depth[:, None]).astype(np.float32)


def triangulate_pair(first: Keyframe, second: Keyframe, config: FrontendConfig) -> tuple[Keyframe, Keyframe]:
    """Give two mono keyframes landmarks from the SIFT matches between them; known landmarks of the first stay."""
    assert first.camera is not None and second.camera is not None
    assert first.T_odom_cam is not None and second.T_odom_cam is not None
    matches = match_descriptors(first.features.descriptors, second.features.descriptors)
    T_first_second = se3.inverse(first.T_odom_cam) @ second.T_odom_cam
    pixels_first = first.features.points[matches[:, 0]]
    pixels_second = second.features.points[matches[:, 1]]
    points, angle = triangulate(
        np.eye(4), first.camera.rays(pixels_first), T_first_second, second.camera.rays(pixels_second)
    )
    in_second = se3.transform(se3.inverse(T_first_second), points)
    good = np.isfinite(points[:, 0]) & (angle > np.deg2rad(config.triangulation_min_angle_deg))
    good &= (points[:, 2] > 0) & (in_second[:, 2] > 0)
    points, in_second, matches = points[good], in_second[good], matches[good]
    close = np.linalg.norm(first.camera.project(points) - pixels_first[good], axis=1) < TRIANGULATION_PX
    close &= np.linalg.norm(second.camera.project(in_second) - pixels_second[good], axis=1) < TRIANGULATION_PX
    points, in_second, matches = points[close], in_second[close], matches[close]

    landmarks_first, landmarks_second = first.landmarks.copy(), second.landmarks.copy()
    unknown = np.isnan(landmarks_first[matches[:, 0], 0])
    landmarks_first[matches[unknown, 0]] = points[unknown]
    landmarks_second[matches[:, 1]] = in_second
    return replace(first, landmarks=landmarks_first), replace(second, landmarks=landmarks_second)
