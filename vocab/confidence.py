"""How sure an answer is: probabilities from the distributions of scores, and what none of them supports."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

ACCEPTED_FROM: Final = 0.95
"""An answer at least so probable is accepted."""

MIN_INLIERS: Final = 8  # unrelated images share up to seven
FEW_INLIERS_DOUBT: Final = 1.0
"""Taken off the scores of a query whose best place has fewer: what is refused ranks below what may be accepted."""


DOUBT_WEIGHT: Final = 0.4


class Verdict(StrEnum):
    """What became of a query: ``accepted``, or the reason why the answer is "nothing here"."""

    ACCEPTED = "accepted"
    UNREADABLE = "unreadable"  # the image could not be read
    EMPTY = "empty"  # there is no place to compare with
    NO_FEATURES = "no_features"  # nothing in the image can be recognised
    FEW_INLIERS = "few_inliers"  # the most similar place shares too few features with it
    UNSURE = "unsure"  # the most similar place is too likely another one
    ELSEWHERE = "elsewhere"  # odometry says that the camera is far from the most similar place
    DOUBT = "doubt"  # several places are about as good and cannot all be right


@dataclass(frozen=True)
class Calibration:
    """Weights of logistic regressions, found by benchmarks/calibrate_places.py (see docs/benchmarks.md).

    ``single``: of 1, the verified score and ln(1 + inliers). ``along_way``: of 1 and the mean evidence along the best
    way, in standard deviations per image. ``spread``: by about as much scores of neighbouring places differ.
    """

    single: tuple[float, float, float]
    along_way: tuple[float, float]
    spread: float

    def probability_single(self, score: float, inliers: int) -> float:
        """Return how probable it is that the best place of one image is the right one (logistic regression).

        ``score`` is that of the place index plus the support of its spatial evidence.
        """
        constant, by_score, by_inliers = self.single
        return _logistic(constant + by_score * score + by_inliers * float(np.log1p(inliers)))

    def probability_along_way(self, evidence: float) -> float:
        """Return how probable it is that the best place of one image of a sequence is the right one."""
        constant, slope = self.along_way
        return _logistic(constant + slope * evidence)

    def doubt(self, scores: Sequence[float]) -> float:
        """Return what to take off the scores of one query, best first, because several places are about as good.

        Nothing for a single place, 0.28 for two equal ones, up to 1.2 for twenty. It orders queries by how sure it is
        that the first place is the very one, not one beside it (gardens_point, compared as they are: recall without an
        error .18 without, .83 with half the weight, .89 with this one and up to three times as much; with one error
        allowed .81, .90, .90).
        """
        if len(scores) == 0:
            return 0.0
        values = np.asarray(scores, np.float64)
        return DOUBT_WEIGHT * float(np.log(np.exp((values - values.max()) / self.spread).sum()))


AS_THEY_ARE: Final = Calibration((-9.491, 14.7, 2.406), (-10.79, 5.271), 0.02)
"""Of scores of the place index."""

TRAVERSALS: Final = Calibration((-7.534, 13.92, 2.034), (-8.896, 5.042), 0.04)
"""Of scores without what all images of either traversal have in common."""


def _logistic(value: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -50.0, 50.0))))
