"""What odometry knows of places: whether the camera can have been where an image was taken before."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.base import Source, Unreadable

NO_SESSION: Final = -1
NEAR_M: Final = 2.0  # between two views of one place
DRIFT_SHARE: Final = 0.01  # of the path between them; odometry with depth errs by a third of that at most
MONO_SHARE: Final = 0.1  # without a scale the path is the only measure
MOST_TURN: Final = float(np.deg2rad(40))
AGREES, UNKNOWN, CONTRADICTS = 1, 0, -1


@dataclass(frozen=True, eq=False)
class Motion:
    """Where odometry says the camera was at each of N images.

    ``T_odom_cam`` (N, 4, 4), ``sessions`` (N,) the session of each pose, NO_SESSION where there is none.
    ``metric`` says that positions are in metres.
    """

    T_odom_cam: NDArray[np.float64]
    sessions: NDArray[np.int64]
    metric: bool

    def judge(self, image: int, places: NDArray[np.int64]) -> NDArray[np.int8]:
        """Return for each of ``places`` (M,), other images, whether ``image`` can show it: (M,) int8.

        CONTRADICTS where both poses are of one session and farther apart than two views of one place and the drift on
        the way between them explain, or turned by more than 40 degrees; AGREES where they are not; UNKNOWN where a pose
        is missing or the sessions differ.
        """
        here, there = self.T_odom_cam[image], self.T_odom_cam[places]
        known = (self.sessions[places] == self.sessions[image]) & (self.sessions[image] != NO_SESSION)
        distance = np.linalg.norm(there[:, :3, 3] - here[:3, 3], axis=1)
        cosine = (np.einsum("mij,ij->m", there[:, :3, :3], here[:3, :3]) - 1) / 2
        lengths = self._lengths()
        way = np.abs(lengths[image] - lengths[places])
        most = NEAR_M + DRIFT_SHARE * way if self.metric else MONO_SHARE * way
        near = (distance <= most) & (np.arccos(np.clip(cosine, -1, 1)) <= MOST_TURN)
        return np.where(known, np.where(near, AGREES, CONTRADICTS), UNKNOWN).astype(np.int8)

    def _lengths(self) -> NDArray[np.float64]:
        """Return the path from the first image to each: (N,). Where a session begins it goes on without a step."""
        steps = np.linalg.norm(np.diff(self.T_odom_cam[:, :3, 3], axis=0), axis=1)
        steps[np.diff(self.sessions) != 0] = 0.0
        return np.concatenate([[0.0], np.cumsum(steps)])


def follow(source: Source, config: FrontendConfig) -> Motion | None:
    """Return the motion of the camera as the front end sees it; None for a source without a calibration."""
    if source.mode is Mode.PLACES or source.rig is None or not source.n_frames:
        return None
    return motion_of(source.frames(), source.n_frames, source.rig, source.mode, config)


def motion_of(
    frames: Iterable[Frame | Unreadable], n_frames: int, rig: Rig, mode: Mode, config: FrontendConfig
) -> Motion:
    """Return the motion of the camera over the first ``n_frames`` frames as the front end sees it."""
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    sessions = np.full(n_frames, NO_SESSION, np.int64)
    frontend = Frontend(rig, mode, config)
    try:
        for number, frame in enumerate(islice(frames, n_frames)):
            if number:
                poses[number] = poses[number - 1]
            if not isinstance(frame, Unreadable):
                said = frontend.step(frame).odometry
                if said.T_odom_cam is not None:
                    poses[number], sessions[number] = said.T_odom_cam, said.session
    finally:
        frontend.close()
    return Motion(poses, sessions, mode is not Mode.MONO)
