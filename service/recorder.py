"""The rerun recording of a run: camera, tracks, keyframes, the way before and after, loops with their image pairs."""

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.backend.types import Loop
from seamark.frontend import se3
from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Keyframe, Matrix, Mode, Odometry, Outcome, Quality
from seamark.service import trajectories
from seamark.service.picture import ACCEPTED, CORRECTED, ODOMETRY, REJECTED
from seamark.service.recording_layout import FRAME_TIMELINE, PLOTS, blueprint
from seamark.service.sources.base import Unreadable
from seamark.service.thumbnails import encode_jpeg, rgb, shrink, side_by_side
from seamark.service.types import RunRecord, Trajectory

APPLICATION = "seamark"
STAMP_TIMELINE = "capture_time"
# The way of odometry is kept in pieces of so many frames, of which only the last one is logged again as it grows:
# logging the whole way every time would cost the square of its length.
PIECE_FRAMES = 64
PIECE_EVERY = 4
PAIR_IMAGE_PX = 320
MAX_PAIRS = 400
QUALITY_LEVEL = {Quality.LOST: 0.0, Quality.MARGINAL: 1.0, Quality.GOOD: 2.0}


class Recorder(Protocol):
    """What a runner tells a recording, in the order in which it happens."""

    def frame(self, frame: Frame | Unreadable, odometry: Odometry) -> None:
        """Record one input frame and what the front end said of it."""

    def keyframe(self, keyframe: Keyframe) -> None:
        """Record a new keyframe."""

    def finish(self, record: RunRecord) -> None:
        """Record the map and the loops, and close the file."""

    def close(self) -> None:
        """Close the file as it is; may be called twice."""


class NullRecorder:
    """Records nothing."""

    def frame(self, frame: Frame | Unreadable, odometry: Odometry) -> None:
        """Do nothing."""

    def keyframe(self, keyframe: Keyframe) -> None:
        """Do nothing."""

    def finish(self, record: RunRecord) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class RerunRecorder:
    """Writes a .rrd file with its own layout; images longer than ``image_px`` are made smaller.

    Times are the running index ("frame") and the sensor's clock ("capture_time"). All methods must be called from one
    thread at a time; each of them sets its own times.
    """

    def __init__(
        self, path: Path, *, name: str, mode: Mode, rig: Rig | None, image_px: int = 640, jpeg_quality: int = 80
    ) -> None:
        # Imported here, because rerun is large and most commands do without it.
        import rerun

        self._rr = rerun
        self._mode = mode
        self._rig = rig
        self._image_px = image_px
        self._jpeg_quality = jpeg_quality
        self._piece: list[NDArray[np.float64]] = []
        self._piece_number = 0
        self._piece_session = -1
        self._pinhole_logged = False
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._stamps: dict[int, int] = {}
        self._recording: Any = rerun.RecordingStream(APPLICATION, recording_id=name)
        self._recording.save(str(path), default_blueprint=blueprint(mode))
        self._recording.send_recording_name(name)
        self._recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._style_plots()

    def frame(self, frame: Frame | Unreadable, odometry: Odometry) -> None:
        """Record one input frame and what the front end said of it."""
        self._set_time(odometry.index, odometry.stamp_ns)
        if isinstance(frame, Frame):
            self._log_image(frame.image, odometry)
        self._log_figures(odometry)
        if odometry.outcome not in (Outcome.TRACKED, Outcome.PLACE):
            self._log_event(frame, odometry)
        if odometry.T_odom_cam is not None:
            self._log_pose(odometry.T_odom_cam, odometry.session, closing=odometry.index % PIECE_EVERY == 0)

    def keyframe(self, keyframe: Keyframe) -> None:
        """Record a new keyframe, and keep a small copy of its image for the pairs of loops."""
        image = cv2.imdecode(np.frombuffer(keyframe.jpeg, np.uint8), cv2.IMREAD_COLOR) if keyframe.jpeg else None
        if image is not None:
            self._pictures[keyframe.id] = np.frombuffer(
                encode_jpeg(shrink(image.astype(np.uint8), PAIR_IMAGE_PX)[0], self._jpeg_quality), np.uint8
            )
        self._stamps[keyframe.id] = keyframe.stamp_ns
        self._set_time(keyframe.index, keyframe.stamp_ns)
        if keyframe.T_odom_cam is not None:
            position = [keyframe.T_odom_cam[:3, 3]]
            self._recording.log(
                "world/odometry/keyframe", self._rr.Points3D(position, colors=rgb(ODOMETRY), radii=-5.0)
            )
        self._recording.log("logs", self._rr.TextLog(f"keyframe {keyframe.id}: {len(keyframe.features)} features"))

    def finish(self, record: RunRecord) -> None:
        """Record the map and the loops, and close the file."""
        self._log_piece()
        self._log_way("world/odometry_in_map", trajectories.odometry_in_map(record), ODOMETRY, 0.7)
        corrected = trajectories.corrected(record)
        self._log_way("world/map/trajectory", [corrected], CORRECTED, 1.5)
        self._log_corrected_camera(record, corrected)
        positions = self._log_keyframes(record)
        self._log_loops(record, positions)
        self.close()

    def close(self) -> None:
        """Close the file as it is; may be called twice."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None

    def _set_time(self, index: int, stamp_ns: int) -> None:
        self._recording.set_time(FRAME_TIMELINE, sequence=index)
        self._recording.set_time(STAMP_TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))

    def _log_image(self, image: NDArray[np.uint8], odometry: Odometry) -> None:
        small, factor = shrink(image, self._image_px)
        if not self._pinhole_logged and self._rig is not None and self._mode is not Mode.PLACES:
            self._pinhole_logged = True
            self._log_pinhole(small, factor)
        contents = encode_jpeg(small, self._jpeg_quality)
        self._recording.log("world/cam/image", self._rr.EncodedImage(contents=contents, media_type="image/jpeg"))
        # Rerun counts from the corner of the top-left pixel, we from its centre.
        now, before = (odometry.tracks[:, :2] + 0.5) * factor, (odometry.tracks[:, 2:] + 0.5) * factor
        self._recording.log("world/cam/image/points", self._rr.Points2D(now, radii=1.5, colors=rgb(ACCEPTED)))
        self._recording.log(
            "world/cam/image/tracks",
            self._rr.LineStrips2D(np.stack([before, now], axis=1), radii=0.6, colors=rgb(ACCEPTED)),
        )

    def _log_pinhole(self, image: NDArray[np.uint8], factor: float) -> None:
        assert self._rig is not None
        camera, rr = self._rig.cam0, self._rr
        pinhole = rr.Pinhole(
            focal_length=[camera.fx * factor, camera.fy * factor],
            principal_point=[(camera.cx + 0.5) * factor, (camera.cy + 0.5) * factor],
            resolution=[image.shape[1], image.shape[0]],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.4,
        )
        self._recording.log("world/cam/image", pinhole, static=True)

    def _log_figures(self, odometry: Odometry) -> None:
        figures = {
            "inliers": float(odometry.inliers),
            "quality": QUALITY_LEVEL[odometry.quality],
            "reprojection_px": odometry.reprojection_px,
            "latency_ms": odometry.latency_ms,
        }
        for name, value in figures.items():
            if np.isfinite(value):
                self._recording.log(f"plots/{name}", self._rr.Scalars(value))

    def _log_event(self, frame: Frame | Unreadable, odometry: Odometry) -> None:
        reason = f" ({frame.reason})" if isinstance(frame, Unreadable) else ""
        level = self._rr.TextLogLevel.WARN if odometry.T_odom_cam is None else self._rr.TextLogLevel.INFO
        self._recording.log("logs", self._rr.TextLog(f"{odometry.file}: {odometry.outcome}{reason}", level=level))

    def _log_pose(self, T_odom_cam: Matrix, session: int, *, closing: bool) -> None:
        self._recording.log("world/cam", self._transform(T_odom_cam))
        if session != self._piece_session or len(self._piece) >= PIECE_FRAMES:
            self._log_piece()
            # Pieces of one session touch each other.
            self._piece = self._piece[-1:] if session == self._piece_session else []
            self._piece_number += 1
            self._piece_session = session
        self._piece.append(T_odom_cam[:3, 3].copy())
        if closing:
            self._log_piece()

    def _log_piece(self) -> None:
        if len(self._piece) > 1 and self._recording is not None:
            strip = self._rr.LineStrips3D([np.stack(self._piece)], colors=rgb(ODOMETRY), radii=-1.0)
            self._recording.log(f"world/odometry/way/{self._piece_number:05d}", strip)

    def _log_way(self, path: str, ways: list[Trajectory], colour: str, radius: float) -> None:
        strips = [way.T_world_cam[:, :3, 3] for way in ways if len(way) > 1]
        if strips:
            self._recording.log(path, self._rr.LineStrips3D(strips, colors=rgb(colour), radii=-radius), static=True)

    def _log_corrected_camera(self, record: RunRecord, corrected: Trajectory) -> None:
        if len(corrected) == 0:
            return
        # Of repeated stamps the first frame is the one with a pose.
        index_of = {frame.stamp_ns: frame.index for frame in reversed(record.odometry)}
        indices = np.array([index_of[int(stamp)] for stamp in corrected.stamps_ns], np.int64)
        rr, path = self._rr, "world/map/cam"
        self._recording.log(path, rr.TransformAxes3D(0.3), static=True)
        self._recording.send_columns(
            path,
            indexes=[
                rr.TimeColumn(FRAME_TIMELINE, sequence=indices),
                rr.TimeColumn(STAMP_TIMELINE, timestamp=corrected.stamps_ns.astype("datetime64[ns]")),
            ],
            columns=rr.Transform3D.columns(
                translation=corrected.T_world_cam[:, :3, 3],
                quaternion=np.stack([se3.to_quaternion(T[:3, :3]) for T in corrected.T_world_cam]),
            ),
        )

    def _log_keyframes(self, record: RunRecord) -> dict[int, NDArray[np.float64]]:
        main = trajectories.main_component(record)
        positions = {
            id_: reference.T_map_cam[:3, 3]
            for id_, reference in trajectories.references(record.snapshot).items()
            if reference.component == main
        }
        if positions:
            points = self._rr.Points3D(np.stack(list(positions.values())), colors=rgb(CORRECTED), radii=-3.5)
            self._recording.log("world/map/keyframes", points, static=True)
        return positions

    def _log_loops(self, record: RunRecord, positions: dict[int, NDArray[np.float64]]) -> None:
        rr, loops = self._rr, record.snapshot.loops
        segments = [
            [positions[loop.query_id], positions[loop.match_id]]
            for loop in loops
            if loop.accepted and loop.query_id in positions and loop.match_id in positions
        ]
        if segments:
            strips = rr.LineStrips3D(np.array(segments), colors=rgb(ACCEPTED), radii=-1.5)
            self._recording.log("world/map/loops", strips, static=True)
        queries = {keyframe.id: keyframe for keyframe in record.keyframes}
        shown = sorted(loops, key=lambda loop: (not loop.accepted, -loop.inliers, loop.query_id, loop.match_id))
        shown = [loop for loop in shown if loop.query_id in queries]
        for loop in shown[:MAX_PAIRS]:
            self._set_time(queries[loop.query_id].index, queries[loop.query_id].stamp_ns)
            self._log_pair(loop)
        # The best loop of each query, which comes first, makes the curves.
        best = {loop.query_id: loop for loop in reversed(shown)}
        for id_ in sorted(best):
            self._set_time(queries[id_].index, queries[id_].stamp_ns)
            self._recording.log("plots/loop_score", self._rr.Scalars(best[id_].score))
            self._recording.log("plots/loop_inliers", self._rr.Scalars(float(best[id_].inliers)))

    def _log_pair(self, loop: Loop) -> None:
        kind = "accepted" if loop.accepted else "rejected"
        text = (
            f"keyframe {loop.query_id} and {loop.match_id}: {loop.reason}, {loop.inliers} inliers, "
            f"score {loop.score:.3f}, votes {loop.votes:.3f}, Jeffrey divergence {loop.jeffrey:.3f}"
        )
        self._recording.log(f"loops/{kind}/log", self._rr.TextLog(text))
        if loop.query_id not in self._pictures or loop.match_id not in self._pictures:
            return
        pictures = [cv2.imdecode(self._pictures[id_], cv2.IMREAD_COLOR) for id_ in (loop.query_id, loop.match_id)]
        pair = side_by_side([np.asarray(one, np.uint8) for one in pictures], ACCEPTED if loop.accepted else REJECTED)
        image = self._rr.EncodedImage(contents=encode_jpeg(pair, self._jpeg_quality), media_type="image/jpeg")
        self._recording.log(f"loops/{kind}/pair", image)

    def _transform(self, T: Matrix) -> Any:
        quaternion = self._rr.Quaternion(xyzw=se3.to_quaternion(T[:3, :3]))
        return self._rr.Transform3D(translation=T[:3, 3], quaternion=quaternion)

    def _style_plots(self) -> None:
        colours = (ACCEPTED, CORRECTED, ODOMETRY, "#8250df", ACCEPTED, CORRECTED)
        for name, colour in zip(PLOTS, colours, strict=True):
            style = self._rr.SeriesLines(colors=rgb(colour), names=name, widths=1.5)
            self._recording.log(f"plots/{name}", style, static=True)
