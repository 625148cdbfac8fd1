"""The start of a mono session: collect views of one set of corners until two of them make a safe first map."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.features import grey_of
from seamark.frontend.first_map import first_map
from seamark.frontend.keyframes import KeyframeBuilder
from seamark.frontend.pose import estimate_pose
from seamark.frontend.pyramid import Pyramid, pyramid_of
from seamark.frontend.session import Session
from seamark.frontend.tracks import Tracks, shared
from seamark.frontend.two_view import TwoView
from seamark.frontend.types import Filled, Frame

MAX_VIEWS = 400
MIN_SURVIVORS = 0.35


@dataclass(frozen=True, eq=False)
class View:
    """What one frame saw before there was a map: its ``tracks`` and their ideal ``pixels`` (N, 2)."""

    index: int
    stamp_ns: int
    tracks: Tracks
    pixels: NDArray[np.float64]


@dataclass(eq=False)
class MonoInitialiser:
    """Views since the ``first`` frame, which will be the first keyframe. ``refusal`` says why the last try failed."""

    first: Frame
    camera: Camera
    config: FrontendConfig
    views: list[View] = field(default_factory=list)
    refusal: str = "no_view"

    def add(self, frame: Frame, tracks: Tracks) -> None:
        """Remember where the live tracks are seen in a frame."""
        pixels = self.camera.undistort(tracks.pixels)
        self.views.append(View(frame.index, frame.stamp_ns, tracks, pixels))

    @property
    def exhausted(self) -> bool:
        """Return whether too few corners of the first frame are left, or it is too long ago, to go on."""
        alive = len(self.views[-1].tracks.ids)
        enough = max(self.config.initial_min_landmarks, MIN_SURVIVORS * len(self.views[0].tracks.ids))
        return alive < enough or len(self.views) > MAX_VIEWS

    def attempt(self) -> tuple[TwoView, NDArray[np.int64]] | None:
        """Try the first against the newest view; returns the map and the track ids of its landmarks."""
        first, newest = self.views[0], self.views[-1]
        i, j = shared(first.tracks.ids, newest.tracks.ids)
        ids = first.tracks.ids[i]
        moved = np.linalg.norm(first.pixels[i] - newest.pixels[j], axis=1)
        if len(ids) == 0 or float(np.median(moved)) < self.config.initial_parallax_px:
            self.refusal = "little_motion"
            return None
        c = self.config
        result = first_map(
            first.pixels[i],
            newest.pixels[j],
            self.camera,
            min_parallax_px=c.initial_parallax_px,
            min_landmarks=c.initial_min_landmarks,
            min_angle_deg=c.triangulation_min_angle_deg,
            pixels_between=self._between(ids),
        )
        if isinstance(result, str):
            self.refusal = result
            return None
        return result, ids

    def _between(self, ids: NDArray[np.int64]) -> NDArray[np.float64] | None:
        """Return where tracks (N,) were seen halfway, (N, 2), NaN where they were not; None where there is no view."""
        if len(self.views) < 3:
            return None
        halfway = self.views[len(self.views) // 2]
        pixels = np.full((len(ids), 2), np.nan)
        i, j = shared(ids, halfway.tracks.ids)
        pixels[i] = halfway.pixels[j]
        return pixels

    def fill(self, session: Session, keyframe_id: int, T_odom_first: NDArray[np.float64]) -> tuple[Filled, ...]:
        """Give the views between the first and the newest their poses against the new landmarks."""
        filled = [Filled(self.first.index, self.first.stamp_ns, session.id, keyframe_id, np.eye(4))]
        c = self.config
        for view in self.views[1:-1]:
            unknown = np.full(len(view.tracks), np.nan)
            observations, _ = session.observations(view.tracks, unknown, unknown)
            pose = estimate_pose(
                observations,
                self.camera,
                threshold_px=c.pnp_threshold_px,
                iterations=c.pnp_iterations,
                pixel_sigma=c.pixel_sigma,
                minimum=c.min_inliers,
            )
            if pose is not None:
                T_first_cam = se3.inverse(T_odom_first) @ pose.T_odom_cam
                filled.append(Filled(view.index, view.stamp_ns, session.id, keyframe_id, T_first_cam))
        return tuple(filled)


def insert_first_keyframes(
    session: Session,
    initialiser: MonoInitialiser,
    frame: Frame,
    image: Pyramid,
    two_view: TwoView,
    ids: NDArray[np.int64],
    builder: KeyframeBuilder,
) -> tuple[Filled, ...]:
    """Make the first and the newest view the first two keyframes; returns the poses of the views before the newest."""
    T_odom_first, first, live = session.T_odom_cam, initialiser.views[0], session.tracks
    session.landmarks.set(ids, se3.transform(T_odom_first, two_view.landmarks), np.zeros(len(ids)))
    a = builder.request(initialiser.first, session.id, None, T_odom_first, None)
    session.tracks = first.tracks[np.isin(first.tracks.ids, live.ids)]
    unknown = np.full(len(session.tracks), np.nan)
    first_image = pyramid_of(grey_of(initialiser.first.image), session.config.flow_levels)
    session.insert_keyframe(a.id, first.stamp_ns, first_image, T_odom_first, unknown, unknown)

    session.tracks = live
    session.add_corners(image.grey, frame.mask)
    unknown = np.full(len(session.tracks), np.nan)
    session.insert_keyframe(
        builder.next_id, frame.stamp_ns, image, T_odom_first @ two_view.T_first_second, unknown, unknown
    )
    session.velocity = np.eye(4)
    session.last_pose_stamp_ns = frame.stamp_ns
    covariance = session.motion_since(T_odom_first, None)
    b = builder.request(frame, session.id, a.id, session.T_odom_cam, covariance)
    builder.submit([a, b])
    return initialiser.fill(session, a.id, T_odom_first)
