"""How probable it is that two images show one place, by looks alone: no geometry, no odometry."""

from typing import Final

import numpy as np

from seamark.frontend.types import Keyframe
from seamark.vocab import confidence, spatial

COMPARED_FEATURES: Final = 500  # the strongest, as many as the probability was calibrated with


def probability(query: Keyframe, match: Keyframe, score: float) -> float:
    """Return how probable it is that two keyframes show one place; ``score`` is that of the place index.

    It is that of ``seamark places match`` (vocab.confidence), without doubt between several places.
    """
    evidence = spatial.compare(_local(query), _local(match))
    return confidence.AS_THEY_ARE.probability_single(
        score + spatial.SUPPORT_WEIGHT * evidence.support, evidence.inliers
    )


def _local(keyframe: Keyframe) -> spatial.LocalFeatures:
    """Without a camera the picture is taken to reach as far as its features."""
    found, part = keyframe.features, slice(COMPARED_FEATURES)
    if keyframe.camera is not None:
        width, height = keyframe.camera.width, keyframe.camera.height
    else:
        width, height = (int(size) + 1 for size in np.ceil(found.points.max(axis=0, initial=0.0)))
    return spatial.LocalFeatures(
        found.points[part], found.scales[part], found.angles[part], found.descriptors[part], width, height
    )
