"""Sub-pixel alignment of patches beyond plain flow: along a known line, or under a known warp.

Plain flow moves a square patch without changing it, with two consequences. Across a stereo pair it slides along edges
that are slanted to the epipolar line, which biases disparities (0.1 px in the mean on driving images, one per cent of
the scale). And from frame to frame its small errors add up, because a patch that comes nearer or turns never fits
exactly. With the line, or the warp, given by what is already known, both go away. Patches are compared after their
means are taken off (Lucas-Kanade with a bias term, Baker and Matthews 2004). The loops are in native/patches.cpp.
"""

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.kernels import native
from seamark.frontend.pyramid import Pyramid


def align_along(
    left: Pyramid,
    right: Pyramid,
    points: NDArray[np.floating],
    start: NDArray[np.floating],
    directions: NDArray[np.floating],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Move ``start`` (N, 2) in the right image along unit ``directions`` (N, 2) until its patch looks like the left
    one's.

    Returns the points (N, 2) float32 and the zero-mean normalised correlation (N,) float32 at the end, in -1..1; what
    is not finite stays where it is, with correlation 0.
    """
    return native.align_along(left, right, _floats(points), _floats(start), _floats(directions))


def align_warped(
    reference: Pyramid,
    image: Pyramid,
    points: NDArray[np.floating],
    start: NDArray[np.floating],
    warps: NDArray[np.floating],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Move ``start`` (N, 2) in an image until its patch looks like the reference's at ``points`` (N, 2), warped.

    ``warps`` (N, 2, 2) maps offsets in the reference to offsets in the image. Returns the points (N, 2) float32 and the
    zero-mean normalised correlation (N,) float32 at the end, in -1..1; what is not finite stays where it is, with
    correlation 0.
    """
    return native.align_warped(reference, image, _floats(points), _floats(start), _floats(np.linalg.inv(warps)))


def _floats(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)
