"""Features and depth of keyframes in memory: within a budget, and read again when they are needed."""

from collections.abc import Callable

import numpy as np

from seamark.backend.map_memory import KeyframeMemory
from seamark.frontend.types import Keyframe


def test_what_gives_way_is_read_again_whole(make_keyframe: Callable[[int], Keyframe]) -> None:
    """Test: room for two of five keyframes. Expected: what is kept takes that, with depth, and all come whole."""
    keyframes = [make_keyframe(number) for number in range(5)]
    read: list[int] = []

    def load(number: int) -> Keyframe:
        read.append(number)
        return keyframes[number]

    def size(keyframe: Keyframe) -> int:
        features = keyframe.features
        arrays = (features.points, features.scales, features.angles, features.descriptors, keyframe.landmarks)
        return sum(array.nbytes for array in arrays) + len(keyframe.depth)

    budget = size(keyframes[3]) + size(keyframes[4])
    memory = KeyframeMemory(budget, load)
    light = [memory.add(keyframe) for keyframe in keyframes]
    assert all(not len(one.features) and one.depth == b"" and one.jpeg == b"" for one in light)
    assert memory.n_bytes == budget
    for number in (4, 3, 0, 1):
        whole = memory.whole(light[number])
        assert whole.depth == keyframes[number].depth != b""
        np.testing.assert_array_equal(whole.features.descriptors, keyframes[number].features.descriptors)
        np.testing.assert_array_equal(whole.landmarks, keyframes[number].landmarks)
    assert read == [0, 1] and 0 < memory.n_bytes <= budget
    memory.forget([0, 1])
    assert memory.whole(light[0]).depth == b"" and read == [0, 1] and memory.n_bytes == 0
