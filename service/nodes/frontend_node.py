"""The front end as a node: frames in; odometry and keyframes out."""

import logging
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.features import grey_of
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Frame, Keyframe, Odometry, Outcome, Quality
from seamark.service import topics
from seamark.service.bus import DRAIN_TIMEOUT_S, Bus, ErrorCode, RemoteError, TimedOutError
from seamark.service.nodes.keyframe_relay import KeyframeRelay
from seamark.service.nodes.meter import Meter
from seamark.service.nodes.process import run_process
from seamark.service.nodes.settings import NodeSettings
from seamark.service.process_end import leave
from seamark.service.requests import Done, EncodedFrame, Status
from seamark.service.sources.decode import UnreadableImageError, decode, to_image

logger = logging.getLogger(__name__)

STOP_PATIENCE_S = 1.0
STALL_S = 2.0  # without an acknowledgement: then the map takes nothing


class FrontendNode:
    """Feeds frames to the front end, one at a time, and sends on what comes out.

    Frames come as requests, where none is lost, or from the stream of a live camera. Keyframe and session numbers begin
    at ``first_keyframe_id`` and ``first_session``. Frames wait for a slow map, unless it is ``patient`` and takes
    nothing for STALL_S: then keyframes are left out, and counted, until it takes them again. Not ``learning``, all are.
    """

    def __init__(
        self,
        bus: Bus,
        frontend: Frontend,
        *,
        first_keyframe_id: int = 0,
        first_session: int = 0,
        patient: bool = False,
        learning: bool = True,
    ) -> None:
        self._bus = bus
        self._frontend = frontend
        self._first_keyframe_id = first_keyframe_id
        self._first_session = first_session
        self._meter = Meter(bus.node)
        self._lock = threading.Lock()  # the camera's stream comes in a thread of its own
        self._patient, self._learning = patient, learning
        self._relay = KeyframeRelay()
        self._stalled = self._stopped = False
        bus.handle(topics.DRAIN[bus.node], self._on_drain)
        bus.handle(topics.STATUS[bus.node], lambda _: self._status(), workers=1)
        bus.handle(topics.FRAME, self._on_frame)
        bus.subscribe(topics.CAMERA, self._on_frame)

    def stop(self) -> None:
        """Take no more frames, send the keyframes that are being made and wait a little for acknowledgements."""
        self._stopped = True
        try:
            self.settle(STOP_PATIENCE_S)
        except TimedOutError as error:
            logger.warning("%s; they are given up", error)

    def settle(self, patience_s: float = DRAIN_TIMEOUT_S) -> None:
        """Send the keyframes that are still being made and wait until all are acknowledged; raises TimedOutError."""
        with self._lock:
            self._send(self._frontend.finish())
        self._bus.drain(patience_s)

    def close(self) -> None:
        """End the threads of the front end."""
        self._frontend.close()

    def _on_frame(self, received: Frame | EncodedFrame) -> Odometry:
        if self._stopped:
            raise RemoteError(ErrorCode.FAILED, "the front end is stopping")
        started = time.perf_counter()
        with self._lock, self._meter.timed("frame"):
            try:
                frame = decode_frame(received)
            except UnreadableImageError:
                odometry = unreadable(received)
            else:
                result = self._frontend.step(frame)
                odometry = self._shift_odometry(result.odometry)
                self._send(result.keyframes)
            odometry = replace(odometry, latency_ms=1e3 * (time.perf_counter() - started))
            self._bus.publish(topics.ODOMETRY, odometry)
        self._meter.count("frames")
        self._meter.count(f"frames_{odometry.outcome}")
        if odometry.loss is not None:
            self._meter.count(f"lost_{odometry.loss}")
        self._meter.add(odometry.stages_ms)
        return odometry

    def _status(self) -> Status:
        for stream, missed in self._bus.dropped.items():
            self._meter.keep(f"{stream}_dropped", missed)
        self._meter.keep_refused(self._bus.refused)
        return self._meter.status()

    def _on_drain(self, _: object) -> Done:
        self.settle()
        return Done(self._bus.node)

    def _send(self, keyframes: tuple[Keyframe, ...]) -> None:
        for keyframe in map(self._shift_keyframe, keyframes):
            if self._patient and self._learning:
                self._stalled = not self._bus.wait_for_room(topics.KEYFRAME, 0.0 if self._stalled else STALL_S)
            if self._stalled or not self._learning:
                self._relay.left_out(keyframe)
                self._meter.count("keyframes_left_out")
                continue
            self._bus.send(topics.KEYFRAME, self._relay.sent(keyframe))
            self._meter.count("keyframes")

    def _shift_keyframe(self, keyframe: Keyframe) -> Keyframe:
        return replace(
            keyframe,
            id=keyframe.id + self._first_keyframe_id,
            session=keyframe.session + self._first_session,
            previous_id=self._shift_id(keyframe.previous_id),
        )

    def _shift_odometry(self, odometry: Odometry) -> Odometry:
        return replace(
            odometry,
            session=self._shift_session(odometry.session),
            reference_id=self._shift_id(odometry.reference_id),
            keyframe_id=self._shift_id(odometry.keyframe_id),
            filled=tuple(
                replace(
                    filled,
                    session=self._shift_session(filled.session),
                    reference_id=filled.reference_id + self._first_keyframe_id,
                )
                for filled in odometry.filled
            ),
        )

    def _shift_id(self, keyframe_id: int | None) -> int | None:
        return None if keyframe_id is None else keyframe_id + self._first_keyframe_id

    def _shift_session(self, session: int) -> int:
        return session if session < 0 else session + self._first_session


def decode_frame(frame: Frame | EncodedFrame) -> Frame:
    """Return the frame with all its pictures decoded; raises UnreadableImageError."""
    if isinstance(frame, Frame):
        return frame
    name = frame.file or f"frame {frame.index}"
    return Frame(
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        image=_decode_image(frame.image, name),
        image_right=None if frame.image_right is None else _decode_image(frame.image_right, name),
        depth=None if frame.depth is None else _decode_depth(frame.depth, name),
        file=frame.file,
        mask=None if frame.mask is None else grey_of(_decode_image(frame.mask, name)),
    )


def unreadable(frame: Frame | EncodedFrame) -> Odometry:
    """Return what is said of a frame whose pictures cannot be decoded."""
    return Odometry(frame.index, frame.stamp_ns, frame.file, -1, Quality.LOST, Outcome.UNREADABLE)


def _decode_image(picture: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    return to_image(decode(picture, name), name) if isinstance(picture, bytes) else picture


def _decode_depth(picture: Any, name: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    depth = decode(picture, name) if isinstance(picture, bytes) else picture
    if depth.ndim != 2 or depth.dtype not in (np.uint16, np.float32):
        raise UnreadableImageError(f"the depth of {name} is {depth.dtype} of shape {depth.shape}")
    return np.ascontiguousarray(depth)


def build(bus: Bus, settings: NodeSettings) -> FrontendNode:
    """Return the node for the settings; raises CalibrationError."""
    frontend = Frontend(settings.rig, settings.mode, settings.config.frontend)
    return FrontendNode(
        bus,
        frontend,
        first_keyframe_id=settings.first_keyframe_id,
        first_session=settings.first_session,
        patient=settings.patient,
        learning=settings.passing_path is not None or not settings.localise_only,
    )


if __name__ == "__main__":
    leave(run_process(topics.FRONTEND, build))
