"""Keyframes on their way to the map, some of which may have to be left out."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.types import Keyframe

Matrix = NDArray[np.float64]


class KeyframeRelay:
    """Hangs each keyframe that is sent on the last one that was, when some between them were left out.

    Odometry poses are of the whole session, so that a gap costs images and no motion: the covariances of the motions
    left out are added up, each moved into the frame of the next keyframe.
    """

    def __init__(self) -> None:
        self._last: Keyframe | None = None  # sent or left out
        self._sent_id: int | None = None
        self._owed: Matrix | None = None  # covariance of what was left out, in the frame of the last keyframe

    def sent(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe as it is to be sent."""
        relinked = keyframe
        if self._owed is not None and self._continues(keyframe):
            relinked = replace(keyframe, previous_id=self._sent_id, covariance=self._summed(keyframe))
        self._last, self._sent_id, self._owed = keyframe, keyframe.id, None
        return relinked

    def left_out(self, keyframe: Keyframe) -> None:
        """Take note of a keyframe that will not be sent."""
        if not self._continues(keyframe):
            self._sent_id = None  # the session has no keyframe in the map yet
        self._owed = self._summed(keyframe)
        self._last = keyframe

    def _continues(self, keyframe: Keyframe) -> bool:
        return self._last is not None and self._last.session == keyframe.session

    def _summed(self, keyframe: Keyframe) -> Matrix:
        own = np.zeros((6, 6)) if keyframe.covariance is None else keyframe.covariance
        last = self._last
        if self._owed is None or last is None or last.session != keyframe.session:
            return own
        if keyframe.T_odom_cam is None or last.T_odom_cam is None:
            return own
        Ad = se3.adjoint(se3.inverse(keyframe.T_odom_cam) @ last.T_odom_cam)
        return np.asarray(Ad @ self._owed @ Ad.T + own)
