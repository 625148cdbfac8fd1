"""The thread that makes what keyframes carry, beside the one that tracks."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import NoDepth
from seamark.frontend.features import extract_features
from seamark.frontend.kernels import native
from seamark.frontend.keyframes import UNHURRIED, KeyframeBuilder
from seamark.frontend.types import Frame, Mode


def noise(height: int, width: int) -> NDArray[np.uint8]:
    """Return a grey image full of key points."""
    return np.random.default_rng(0).integers(0, 255, (height, width), np.uint8)


def test_key_points_let_pass_and_are_the_same() -> None:
    """Test: the way is taken while key points are sought. Expected: nothing comes before it is given back or patience
    is at its end; then the same bits as without."""
    image, way = noise(240, 320), native.RightOfWay()
    undisturbed = extract_features(image, 500)
    with ThreadPoolExecutor(1) as pool:
        for repeat in range(20):
            way.take()
            began = time.monotonic()
            features = pool.submit(extract_features, image, 500, way=way)
            while not features.done() and time.monotonic() < began + 0.02:
                pass
            early = features.done() and time.monotonic() < began + 0.02
            way.give_back()
            assert not early, repeat
            for name in ("points", "scales", "angles", "descriptors"):
                assert np.array_equal(getattr(features.result(), name), getattr(undisturbed, name))


def test_patience_ends() -> None:
    """Test: the way is never given back. Expected: the same key points, later."""
    image, way = noise(120, 160), native.RightOfWay()
    way.take()
    late = extract_features(image, 100, way=way)
    assert np.array_equal(late.points, extract_features(image, 100).points)


def test_a_thread_that_has_fallen_behind_is_not_held_up() -> None:
    """Test: many keyframes, then tracking without end. Expected: all are made while tracking goes on, in order."""
    builder = KeyframeBuilder(None, Mode.PLACES, FrontendConfig(), NoDepth())
    image = noise(120, 160)
    for index in range(UNHURRIED + 3):
        builder.submit([builder.request(Frame(index, index, image), session=0)])
    with builder.tracking():
        deadline, made = time.monotonic() + 20, list(builder.take())
        while len(made) < UNHURRIED + 3 and time.monotonic() < deadline:
            made += builder.take()
    assert [keyframe.id for keyframe in made] == list(range(UNHURRIED + 3))
    builder.close()
