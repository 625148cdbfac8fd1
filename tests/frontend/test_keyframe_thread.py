"""The thread that makes what keyframes carry, beside the one that tracks."""

import time
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.frontend.depth import NoDepth
from seamark.frontend.features import extract_features
from seamark.frontend.kernels import native
from seamark.frontend.keyframes import UNHURRIED, KeyframeBuilder
from seamark.frontend.types import Frame, Keyframe, Mode


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
    """Test: tracking beside an idle thread, and beside one with a long queue. Expected: the way is taken from the first
    only and given back at the end, and all keyframes come in order."""
    builder = KeyframeBuilder(None, Mode.PLACES, FrontendConfig(), NoDepth())
    image = noise(480, 640)
    with builder.tracking():
        assert builder.way.taken
    assert not builder.way.taken
    for index in range(UNHURRIED + 3):
        builder.submit([builder.request(Frame(index, index, image), session=0)])
    with builder.tracking():
        assert not builder.way.taken
    builder.wait()
    assert [keyframe.id for keyframe in builder.take()] == list(range(UNHURRIED + 3))
    builder.close()


def test_who_waits_for_keyframes_while_tracking_does_not_hold_them_up() -> None:
    """Test: a search for the last place in the midst of a step. Expected: the way is free while it is waited for."""
    builder = KeyframeBuilder(None, Mode.PLACES, FrontendConfig(), NoDepth())
    taken_while_waiting = []

    class Pending(Future[list[Keyframe]]):
        def result(self, timeout: float | None = None) -> list[Keyframe]:
            taken_while_waiting.append(builder.way.taken)
            return []

    builder._pending.append(Pending())
    with builder.tracking():
        assert builder.way.taken
        assert builder.recent(0) == []
    assert taken_while_waiting == [False]
    builder.close()
