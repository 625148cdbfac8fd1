"""The small depth image of a keyframe: means of squares, nothing across edges, and no trust in what arrives."""

import contextlib
import struct

import cv2
import numpy as np
import pytest

from seamark.frontend.camera import Camera, Rig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import make_depth_sensor
from seamark.frontend.keyframe_depth import STEPS, DepthError, decode_depth, encode_depth, reduce_depth
from seamark.frontend.keyframes import KeyframeBuilder
from seamark.frontend.types import Frame, Keyframe, Mode

CONFIG = FrontendConfig(keyframe_depth_px=160)


def by_squares(depth_m: np.ndarray, block: int) -> np.ndarray:
    """Work the image out square by square, as the document says it."""
    h, w = depth_m.shape[0] // block, depth_m.shape[1] // block
    out = np.zeros((h, w))
    for row in range(h):
        for column in range(w):
            z = depth_m[row * block : (row + 1) * block, column * block : (column + 1) * block].ravel()
            z = z[np.isfinite(z) & (z > CONFIG.depth_min_m) & (z < CONFIG.depth_max_m)]
            if 2 * len(z) < block * block:
                continue
            mean = (1 / z).mean()
            noise = CONFIG.depth_sigma_floor_m * mean**2 + CONFIG.depth_sigma_per_m2
            if (1 / z).max() - (1 / z).min() < max(0.05 * mean, 6 * noise):
                out[row, column] = mean
    return out


@pytest.mark.parametrize("width, block", [(640, 4), (320, 2), (543, 3), (100, 1)])
def test_squares_are_averaged_and_edges_and_holes_left_out(width: int, block: int) -> None:
    rng = np.random.default_rng(width)
    rows, columns = np.indices((123, width))
    depth = 1.5 + 0.004 * columns + 0.002 * rows + 0.004 * rng.standard_normal((123, width))
    depth[40:80, 30:67] = 0.9  # something before it
    depth[rng.random(depth.shape) < 0.3] = 0.0
    depth[90:100, :50] = np.nan
    depth[100:, :50] = 40.0
    found = reduce_depth(depth.astype(np.float32), 1.0, CONFIG)
    expected = by_squares(depth.astype(np.float32), block)
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found > 0, expected > 0)
    assert 0.3 < (found > 0).mean() < 0.95
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_whole_numbers_are_metres_by_the_factor_and_masks_hold() -> None:
    depth = np.full((240, 320), 10_000, np.uint16)
    mask = np.full((240, 320), 255, np.uint8)
    mask[:120] = 0
    inverse = decode_depth(encode_depth(depth, 5000.0, CONFIG, mask))
    assert inverse.shape == (120, 160)
    assert (inverse[:60] == 0).all() and (inverse[60:] == 0.5).all()


def test_what_is_decoded_is_what_was_encoded_to_half_a_step() -> None:
    rng = np.random.default_rng(1)
    depth = np.repeat(np.repeat(rng.uniform(0.25, 9.5, (60, 80)), 4, 0), 4, 1).astype(np.float32)
    config = CONFIG.model_copy(update={"keyframe_depth_px": 80})
    inverse = decode_depth(encode_depth(depth, 1.0, config))
    error = np.abs(inverse - 1 / depth[::4, ::4])
    assert error.max() <= 0.5001 / STEPS and error.max() > 0.4 / STEPS


def test_an_image_too_small_to_be_reduced_gives_nothing() -> None:
    assert encode_depth(np.full((1, 400), 1.0, np.float32), 1.0, CONFIG) == b""


def test_bytes_that_are_no_depth_raise() -> None:
    png = encode_depth(np.full((120, 160), 1.5, np.float32), 1.0, CONFIG)
    huge = png[:16] + struct.pack(">II", 1 << 30, 1 << 30) + png[24:]
    grey = cv2.imencode(".png", np.zeros((10, 10), np.uint8))[1].tobytes()
    colour = cv2.imencode(".png", np.zeros((10, 10, 3), np.uint16))[1].tobytes()
    for bad in (b"", b"\x89PNG", png[:40], huge, grey, colour, b"\xff\xd8" + png, png[:16] + b"\0" * 8 + png[24:]):
        with pytest.raises(DepthError):
            decode_depth(bad)
    rng = np.random.default_rng(2)
    for _ in range(200):
        flipped = bytearray(png)
        flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
        with contextlib.suppress(DepthError):
            assert decode_depth(bytes(flipped)).ndim == 2


def made(mode: Mode, depth: np.ndarray | None, config: FrontendConfig) -> Keyframe:
    camera = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
    rig = Rig(camera, depth_factor=5000.0)
    builder = KeyframeBuilder(rig, mode, config, make_depth_sensor(rig, mode, config))
    image = np.random.default_rng(3).integers(0, 255, (240, 320), np.uint8)
    builder.submit([builder.request(Frame(0, 1, image, depth=depth), 0)])
    builder.wait()
    (keyframe,) = builder.take()
    builder.close()
    return keyframe


def test_keyframes_of_a_depth_camera_carry_it_and_others_do_not() -> None:
    depth = np.full((240, 320), 7_500, np.uint16)
    carried = decode_depth(made(Mode.RGBD, depth, CONFIG).depth)
    np.testing.assert_allclose(carried, 1 / 1.5, atol=0.5 / STEPS)
    assert made(Mode.RGBD, None, CONFIG).depth == b""
    assert made(Mode.MONO, depth, CONFIG).depth == b""
    assert made(Mode.RGBD, depth, FrontendConfig()).depth == b""
