"""How well places are recognised: recall at N, precision against recall, and thresholds with a confidence bound."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

RECALL_AT: Final = (1, 5, 10, 20)
CONFIDENCE: Final = 0.95
BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class Curve:
    """Precision and recall when only answers of at least ``threshold`` are given, from the surest to all: (n,) each.

    ``answered`` and ``right`` count the answers. Precision is right / answered; recall is right / queries that have a
    true place, so that an answer to a query that has none is always wrong.
    """

    threshold: NDArray[np.float64]
    answered: NDArray[np.int64]
    right: NDArray[np.int64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]


@dataclass(frozen=True)
class Threshold:
    """Answers of at least ``value`` are right with at least ``precision_bound`` (95 % sure); None where none is."""

    value: float | None
    precision: float
    precision_bound: float
    recall: float
    answered: int


def recall_at(ranked: Sequence[Sequence[int]], true_places: NDArray[np.bool_], n: int) -> float:
    """Return the share of the queries with a true place that have one among their first ``n``; NaN if none has.

    ``ranked`` lists places for each query, best first; ``true_places`` is (queries, places).
    """
    asked = np.flatnonzero(true_places.any(axis=1)).tolist()
    if not asked:
        return math.nan
    return sum(bool(true_places[query, list(ranked[query][:n])].any()) for query in asked) / len(asked)


def curve(scores: NDArray[np.float64], right: NDArray[np.bool_], n_matchable: int) -> Curve:
    """Return the curve over all thresholds: ``scores`` and ``right`` (n,) of each query's first place."""
    order = np.argsort(-scores, kind="stable")
    ordered = scores[order]
    last_of_equal = np.append(ordered[1:] != ordered[:-1], True) if len(ordered) else np.zeros(0, np.bool_)
    answered = np.arange(1, len(ordered) + 1)[last_of_equal]
    hits = np.cumsum(right[order])[last_of_equal].astype(np.int64)
    recall = hits / n_matchable if n_matchable else np.zeros(len(hits))
    return Curve(ordered[last_of_equal], answered, hits, hits / np.maximum(answered, 1), recall)


def recall_at_full_precision(found: Curve) -> float:
    """Return the greatest recall without a single wrong answer."""
    return float(found.recall[found.right == found.answered].max(initial=0.0))


def choose_threshold(found: Curve, wanted_precision: float) -> Threshold:
    """Return the threshold of greatest recall whose precision is, 95 % sure, at least ``wanted_precision``."""
    bounds = np.array([lower_bound(int(r), int(n)) for r, n in zip(found.right, found.answered, strict=True)])
    good = np.flatnonzero(bounds >= wanted_precision)
    if not len(good):
        return Threshold(None, math.nan, float(bounds.max(initial=0.0)), 0.0, 0)
    best = int(good[found.recall[good].argmax()])
    return Threshold(
        float(found.threshold[best]),
        float(found.precision[best]),
        float(bounds[best]),
        float(found.recall[best]),
        int(found.answered[best]),
    )


def lower_bound(successes: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """Return the one-sided lower bound of a proportion (Clopper and Pearson 1934): 0 where nothing succeeded.

    It is the proportion at which so many successes or more would be seen with probability 1 - ``confidence``.
    """
    if successes == 0:
        return 0.0
    low, high = 0.0, successes / trials
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if _at_least(successes, trials, middle) < 1.0 - confidence:
            low = middle
        else:
            high = middle
    return low


def _at_least(successes: int, trials: int, proportion: float) -> float:
    """Return the probability of so many successes or more of a binomial distribution."""
    if proportion <= 0.0:
        return 0.0
    if proportion >= 1.0:
        return 1.0
    logarithms = [
        math.lgamma(trials + 1)
        - math.lgamma(k + 1)
        - math.lgamma(trials - k + 1)
        + k * math.log(proportion)
        + (trials - k) * math.log1p(-proportion)
        for k in range(successes, trials + 1)
    ]
    return math.fsum(math.exp(value) for value in logarithms)
