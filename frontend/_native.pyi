from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

_Camera: TypeAlias = tuple[float, float, float, float]
_Aligned: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]

def levels() -> list[str]: ...

class Pyramid:
    def __init__(self, grey: NDArray[np.uint8], levels: int) -> None: ...
    @property
    def top(self) -> int: ...
    @property
    def grey(self) -> NDArray[np.uint8]: ...
    def level(self, level: int) -> NDArray[np.uint8]: ...

def follow(
    before: Pyramid,
    after: Pyramid,
    points: NDArray[np.float32],
    start: NDArray[np.float32],
    side: int,
    top: int,
    back_top: int,
    level: str | None = None,
    level_out: bool = True,
    least_likeness: float = -1.0,
    reach: float = ...,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]: ...
def strongest(
    image: NDArray[np.uint8], cell: int, border: int, harris_k: float, mask: NDArray[np.uint8] | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]: ...

class RightOfWay:
    def __init__(self) -> None: ...
    @property
    def taken(self) -> bool: ...
    def take(self) -> None: ...
    def give_back(self) -> None: ...

def sift(
    image: NDArray[np.uint8],
    mask: NDArray[np.uint8] | None,
    most: int,
    contrast: float,
    way: RightOfWay | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]: ...
def median_difference(image: NDArray[np.uint8]) -> float: ...
def apart(
    points: NDArray[np.float32], others: NDArray[np.float32], distance: float, to_each_other: bool
) -> NDArray[np.bool_]: ...
def align_along(
    source: Pyramid,
    target: Pyramid,
    points: NDArray[np.float32],
    start: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> _Aligned: ...
def align_warped(
    source: Pyramid,
    target: Pyramid,
    points: NDArray[np.float32],
    start: NDArray[np.float32],
    unwarp: NDArray[np.float32],
) -> _Aligned: ...
def converge(
    T_odom_cam: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    landmarks: NDArray[np.float64],
    pixels: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    inverse_sigma: NDArray[np.float64],
    spread: NDArray[np.float64] | None,
    origin: NDArray[np.float64] | None,
    votes: NDArray[np.float64],
    camera: _Camera,
    pixel_sigma: float,
    expected: NDArray[np.float64] | None,
    sigma_m: float,
    threshold_px: float,
    nearest_m: float,
    minimum: int,
    iterations: int,
    least_step: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], float, float, float] | None: ...
def adjust(
    poses: NDArray[np.float64],
    n_fixed: int,
    landmarks: NDArray[np.float64],
    keyframe_of: NDArray[np.int64],
    landmark_of: NDArray[np.int64],
    pixels: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    inverse_sigma: NDArray[np.float64],
    camera: _Camera,
    pixel_sigma: float,
    offset: float,
    offset_information: float,
    iterations: int,
    damping: float,
    least_decrease: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float]: ...
