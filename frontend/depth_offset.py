"""What a depth sensor gets wrong in the same way in every frame, learned from the camera's own motion.

No calibration of a stereo rig is exact: a few tenths of a milliradian between its cameras shift all disparities by
some tenths of a pixel. Points are then consistently too far or too near and the trajectory too long or too short, by an
amount that no further measurement averages out. Motion gives it away, because it triangulates near and far points
with one unknown step, while an offset of the disparity weighs on far points more. The local window estimates the
offset together with poses and landmarks. One number for the whole image, on purpose: an error field of first or
second order fits better still, and gives a worse scale, because it takes up what the lens model leaves as well.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MEMORY_KEYFRAMES = 200  # after so many, what was learned counts for a third: rigs warm up and are knocked
SMALLEST_SIGMA = 1e-12


@dataclass(frozen=True)
class DepthOffset:
    """Estimate of the offset: true inverse depth = reading + ``value`` (1/m).

    ``information`` is the inverse variance (m^2), ``prior`` that of what is known without having seen anything.
    """

    value: float
    information: float
    prior: float

    @staticmethod
    def expected(sigma: float) -> "DepthOffset":
        """Return the knowledge before the first frame: an offset of about ``sigma`` (1/m), none for 0."""
        prior = 1 / max(sigma, SMALLEST_SIGMA) ** 2
        return DepthOffset(0.0, prior, prior)

    def correct(self, inverse_depth: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return readings (N,) without the offset, NaN where that leaves nothing positive."""
        corrected = inverse_depth + self.value
        with np.errstate(invalid="ignore"):
            return np.where(corrected > 0, corrected, np.nan)

    def learned(self, value: float, information: float) -> "DepthOffset":
        """Return the knowledge after a window that gave a ``value`` by new observations of that ``information``."""
        kept = self.prior + (1 - 1 / MEMORY_KEYFRAMES) * (self.information - self.prior)
        return DepthOffset(value, kept + information, self.prior)
