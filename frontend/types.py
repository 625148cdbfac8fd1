"""What the front end takes and gives, and the conventions that hold in every room.

- ``T_a_b`` is a (4, 4) float64 matrix that maps coordinates of frame b into frame a; products chain: ``T_a_b @ T_b_c``.
- Camera frame: x right, y down, z forward. World frames: x forward, y left, z up (REP-103). Without gravity the first
  camera of a session is taken as level and looking along x of its odometry frame.
- The centre of the top-left pixel is (0, 0). Points are (N, 2) arrays of (x, y).
- Stamps are int nanoseconds of the sensor's clock. Lengths are metres and angles radians unless a name says otherwise.
- A 6x6 covariance is in the tangent space of the child frame (right perturbation), rotation first, then translation.
- Descriptors are RootSIFT scaled to uint8, 128 per key point.
- Arrays in messages are read-only.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Camera, Rig

__all__ = ["Camera", "Features", "Filled", "Frame", "Keyframe", "Loss", "Mode", "Odometry", "Outcome", "Quality", "Rig"]

FloatArray = NDArray[np.floating]
Matrix = NDArray[np.float64]


class Mode(StrEnum):
    """Which sensors carry the motion; ``PLACES`` recognises places only and knows no poses."""

    MONO = "mono"
    STEREO = "stereo"
    RGBD = "rgbd"
    PLACES = "places"


class Quality(StrEnum):
    """How far the pose of one frame can be trusted; ``LOST`` means that there is none."""

    GOOD = "good"
    MARGINAL = "marginal"
    LOST = "lost"


class Outcome(StrEnum):
    """What happened to one input frame (column ``outcome`` of frames.csv)."""

    TRACKED = "tracked"
    RECOVERED = "recovered"  # flow failed, descriptors against the last keyframe held
    INITIALISING = "initialising"  # mono, before the first two-view map
    NEW_SESSION = "new_session"  # the first frame of a session
    LOST = "lost"
    PLACE = "place"  # mode places: a keyframe without a pose
    UNREADABLE = "unreadable"  # missing, truncated or undecodable file, or a picture of a wrong type
    WRONG_SIZE = "wrong_size"  # an image contradicts the calibration, or depth its image
    REPEATED_STAMP = "repeated_stamp"
    STAMP_BACKWARD = "stamp_backward"  # before the newest stamp
    STAMP_FORWARD = "stamp_forward"  # far after it, and the first to say so
    CLOCK_RESET = "clock_reset"  # the first frame believed after the clock was set back: of a new session


class Loss(StrEnum):
    """Why a frame that could be used has no pose (outcome LOST, or CLOCK_RESET with nothing to see)."""

    DARK = "dark"  # nearly all of the image is black
    BRIGHT = "bright"  # most of the image is blown out
    FEATURELESS = "featureless"  # too few corners: a wall, a covered lens
    UNMATCHED = "unmatched"  # enough to see, but nothing of it was known


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of the sensor.

    ``image`` is (H, W) grey or (H, W, 3) BGR, uint8. ``image_right`` is (H, W) or (H, W, 3) uint8 for stereo. ``depth``
    is (H, W) along the optical axis of ``image``: float32 metres, or uint16 in units of 1 / ``rig.depth_factor``
    metres; zero and non-finite mean unknown. ``file`` names the frame in reports. ``mask`` (H, W) uint8 is zero where
    the image must not be used: nothing is tracked or remembered there.
    """

    index: int
    stamp_ns: int
    image: NDArray[np.uint8]
    image_right: NDArray[np.uint8] | None = None
    depth: NDArray[np.uint16] | NDArray[np.float32] | None = None
    file: str = ""
    mask: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Features:
    """Key points of one image with their descriptors.

    ``points`` (N, 2) float32 pixels as seen (distorted), ``scales`` (N,) float32 diameters in pixels, ``angles`` (N,)
    float32 radians, ``descriptors`` (N, 128) uint8 RootSIFT.
    """

    points: NDArray[np.float32]
    scales: NDArray[np.float32]
    angles: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        """Return the number of key points."""
        return len(self.points)

    @staticmethod
    def empty() -> "Features":
        """Return the features of an image that has none."""
        return Features(
            np.zeros((0, 2), np.float32),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
            np.zeros((0, 128), np.uint8),
        )


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that the map remembers.

    ``id`` counts all keyframes of a run from 0. ``previous_id`` is the keyframe before it in the same session, or None.
    ``T_odom_cam`` is its odometry pose, None in mode places. ``covariance`` (6, 6) is of the motion since the previous
    keyframe. ``landmarks`` (N, 3) float32 are the features' points in this camera's frame, NaN where depth is unknown.
    ``metric`` is False where the session's scale is arbitrary (mono). ``camera`` is None without calibration.
    ``jpeg`` is the image, ``thumbnail`` a small (h, w) grey or (h, w, 3) BGR uint8 copy for the colour histograms.
    ``depth`` is a small depth image of RGB-D sensors (see keyframe_depth.py), empty without one.
    """

    id: int
    session: int
    index: int
    stamp_ns: int
    file: str
    features: Features
    landmarks: NDArray[np.float32]
    thumbnail: NDArray[np.uint8]
    jpeg: bytes
    camera: Camera | None = None
    previous_id: int | None = None
    T_odom_cam: Matrix | None = None
    covariance: Matrix | None = None
    metric: bool = True
    depth: bytes = b""


@dataclass(frozen=True, eq=False)
class Filled:
    """The pose, found later, of a frame that was passed before mono initialisation: in the frame of a keyframe."""

    index: int
    stamp_ns: int
    session: int
    reference_id: int
    T_reference_cam: Matrix


@dataclass(frozen=True, eq=False)
class Odometry:
    """What the front end says of one input frame, once, when it has been processed.

    ``T_odom_cam`` is None when there is no pose. ``T_reference_cam`` is the same pose in the frame of keyframe
    ``reference_id``, from which the map's pose follows: ``T_map_reference @ T_reference_cam``. ``session`` is -1 when
    the frame belongs to none. ``covariance`` (6, 6) is of the motion since the reference keyframe. ``filled`` gives
    poses of earlier frames that became known with this one. ``inliers`` counts landmarks that the pose rests on and
    ``reprojection_px`` is their median error, NaN where none was measured: no pose, or the first of a session.
    ``near_share`` is the share of the inliers whose distance is known to better than a tenth: these hold the
    translation, the others only the rotation. ``loss`` says why there is no pose where one could have been. ``tracks``
    (M, 4) float32 are the inlier tracks (x, y, x_before, y_before) in pixels, for people, and ``track_ages`` (M,) int32
    for how many posed frames they have lived. ``motion_mask`` (h, w) uint8, made while the camera stands still, is 255
    where something moves; one element is for a square of pixels (see motion_mask.py).
    """

    index: int
    stamp_ns: int
    file: str
    session: int
    quality: Quality
    outcome: Outcome
    inliers: int = 0
    reprojection_px: float = float("nan")
    latency_ms: float = float("nan")
    T_odom_cam: Matrix | None = None
    reference_id: int | None = None
    T_reference_cam: Matrix | None = None
    covariance: Matrix | None = None
    keyframe_id: int | None = None
    filled: tuple[Filled, ...] = ()
    tracks: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    stages_ms: dict[str, float] = field(default_factory=dict)
    near_share: float | None = None
    loss: Loss | None = None
    track_ages: NDArray[np.int32] | None = None
    motion_mask: NDArray[np.uint8] | None = None
