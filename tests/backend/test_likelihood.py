"""How probable it is that two keyframes show one place, by looks alone."""

from dataclasses import replace

import numpy as np

from seamark.backend.likelihood import probability
from seamark.frontend.types import Features, Keyframe


def keyframe(seed: int, count: int = 300) -> Keyframe:
    rng = np.random.default_rng(seed)
    features = Features(
        rng.uniform((0, 0), (640, 480), (count, 2)).astype(np.float32),
        rng.uniform(2, 8, count).astype(np.float32),
        rng.uniform(-0.1, 0.1, count).astype(np.float32),
        rng.integers(0, 256, (count, 128), dtype=np.uint8),
    )
    return Keyframe(
        id=seed,
        session=0,
        index=seed,
        stamp_ns=0,
        file="",
        features=features,
        landmarks=np.full((count, 3), np.nan, np.float32),
        thumbnail=np.zeros((1, 1), np.uint8),
        jpeg=b"",
        camera=None,
    )


def test_the_same_features_are_the_same_place_and_others_are_not() -> None:
    place, other, empty = keyframe(1), keyframe(2), keyframe(3, count=0)
    features = replace(place.features, points=place.features.points + np.float32(9.0))
    assert probability(replace(place, features=features), place, 0.5) > 0.99
    assert probability(other, place, 0.1) < 0.05
    assert probability(empty, place, 0.0) < 0.001 and probability(place, empty, 0.0) < 0.001


def test_a_likelier_index_makes_a_place_likelier() -> None:
    few = keyframe(4, count=12)
    low, high = probability(few, few, 0.05), probability(few, few, 0.3)
    assert 0.0 < low < high < 1.0
