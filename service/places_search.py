"""Every query image against a database of images: ranked, verified, decided."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from seamark.service.places_images import DescribedImage
from seamark.service.places_motion import AGREES, CONTRADICTS, Motion
from seamark.vocab import confidence, histogram, sequence, traversals, view
from seamark.vocab.confidence import Calibration, Verdict
from seamark.vocab.config import VocabConfig
from seamark.vocab.place_index import PlaceIndex
from seamark.vocab.spatial import SUPPORT_WEIGHT, SpatialEvidence, compare
from seamark.vocab.types import Candidate
from seamark.vocab.vocabulary import Vocabulary

VERIFIED = 20  # places of a query that are compared feature by feature
CONTRADICTED, CONTRADICTED_IN_ORDER = 1.0, 5.0
"""Taken off the score of a place that odometry contradicts: it ranks below all others."""

STREAK = 4  # successive queries that found neighbouring places where odometry expects them
STREAK_INLIERS = 20  # that each of them must have
STREAK_STEP = 4  # places from one to the next
DATABASE_SESSION, QUERY_SESSION, QUERY_ID = 0, 1, -1


@dataclass(frozen=True)
class Match:
    """One place for one query: ``place`` counts the images of the database, ``score`` is higher for better ones.

    It compares queries too: where many places look alike, all of them score lower (Calibration.doubt). ``inliers``
    counts the features that agree in position; it is 0 for places that were not compared.
    """

    place: int
    score: float
    votes: float
    jeffrey: float
    inliers: int
    accepted: bool = False


@dataclass(frozen=True)
class Answer:
    """The ranked places of one query, the probability that the first shows the place, and the verdict.

    ``evidence`` is what the probability rests on: the score of the first place before doubt was taken off, or its
    evidence along the way.
    """

    matches: tuple[Match, ...]
    evidence: float
    probability: float
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class _Table:
    """All places for all queries: ``score``, ``votes``, ``jeffrey`` and ``view`` (queries, places) float32.

    The score is NaN where a place may not be asked for.
    """

    score: NDArray[np.float32]
    votes: NDArray[np.float32]
    jeffrey: NDArray[np.float32]
    view: NDArray[np.float32]


def search(
    database: Sequence[DescribedImage],
    queries: Sequence[DescribedImage],
    vocabulary: Vocabulary,
    config: VocabConfig,
    *,
    top: int,
    in_order: bool,
    workers: int,
    together: bool = False,
) -> list[Answer]:
    """Answer every query with ``top`` places, fewer only where the database is smaller.

    ``in_order`` says that both were taken along a way, and lets neighbours count. With ``together`` what all images of
    either set have in common is left out of the comparison. With neither the answer to a query depends on no other.
    """
    index = PlaceIndex(vocabulary, config)
    for number, image in enumerate(database):
        index.add(image.observation(number, DATABASE_SESSION))
    table = _empty_table(len(queries), len(database))
    for row, query in enumerate(queries):
        _fill(table, row, index.query(query.observation(QUERY_ID, QUERY_SESSION), len(database)).ranked)
    if together and len(queries) and len(database):
        table = replace(table, score=_score_traversals(table, database, queries, config))
    calibration = confidence.TRAVERSALS if together else confidence.AS_THEY_ARE
    return _answers(table, database, queries, top, in_order, workers, calibration)


def search_own(
    images: Sequence[DescribedImage],
    stamps_ns: Sequence[int],
    vocabulary: Vocabulary,
    config: VocabConfig,
    *,
    top: int,
    in_order: bool,
    workers: int,
    motion: Motion | None = None,
) -> tuple[list[Answer], NDArray[np.bool_]]:
    """Answer every image of one sequence with places seen before it, the recent past excluded.

    ``motion`` is what odometry says of these images. A place that it contradicts ranks last and is never accepted: two
    places that look alike are told apart by nothing else as long as only one of them is known. In order, STREAK
    successive images that found neighbouring places where odometry expects them are accepted.

    Returns the answers and (n, n) bool: which places each image might have been answered with.
    """
    index = PlaceIndex(vocabulary, config)
    table = _empty_table(len(images), len(images))
    for row, (image, stamp_ns) in enumerate(zip(images, stamps_ns, strict=True)):
        observation = image.observation(row, DATABASE_SESSION, stamp_ns)
        _fill(table, row, index.query(observation, max(1, len(index))).ranked)
        index.add(observation)
    answers = _answers(table, images, images, top, in_order, workers, confidence.AS_THEY_ARE, motion)
    if in_order and motion is not None:
        answers = _accept_streaks(answers, motion)
    return answers, np.isfinite(table.score)


def _score_traversals(
    table: _Table, database: Sequence[DescribedImage], queries: Sequence[DescribedImage], config: VocabConfig
) -> NDArray[np.float32]:
    """Return the scores (queries, places) of two traversals without what all images of each have in common."""
    places, asking = ([image for image in images if image.problem is None] for images in (database, queries))
    beyond = np.zeros_like(table.score)
    readable = np.ix_(*(np.flatnonzero([image.problem is None for image in images]) for images in (queries, database)))
    beyond[readable] = traversals.view_likeness(_cells(asking), _cells(places))
    likeness = traversals.AS_THEY_ARE * table.view + (1.0 - traversals.AS_THEY_ARE) * beyond
    trust = traversals.histogram_trust(*_histograms(asking, config), *_histograms(places, config))
    said = np.array([min(1.0, len(image.descriptors) / config.trusted_features) for image in queries], np.float32)
    return traversals.fuse(config, table.votes * said[:, None], table.jeffrey, likeness, trust)


def _cells(images: Sequence[DescribedImage]) -> NDArray[np.int8]:
    return np.stack([view.describe(image.thumbnail).cells for image in images]) if images else view.NO_CELLS


def _histograms(images: Sequence[DescribedImage], config: VocabConfig) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    bins, sigma_bins = config.histogram_bins, config.histogram_sigma_bins
    found = [histogram.describe(image.thumbnail, bins, sigma_bins) for image in images]
    if not found:
        channels = len(histogram.CHANNELS)
        return np.zeros((0, channels, bins), np.float32), np.zeros((0, channels), np.bool_)
    return np.stack([one.values for one in found]), np.stack([one.present for one in found])


def _empty_table(queries: int, places: int) -> _Table:
    score = np.full((queries, places), np.nan, np.float32)
    return _Table(score, np.zeros_like(score), np.zeros_like(score), np.zeros_like(score))


def _fill(table: _Table, row: int, ranked: Sequence[Candidate]) -> None:
    places = [candidate.id for candidate in ranked]
    table.score[row, places] = [candidate.score for candidate in ranked]
    table.votes[row, places] = [candidate.votes for candidate in ranked]
    table.jeffrey[row, places] = [candidate.jeffrey for candidate in ranked]
    table.view[row, places] = [candidate.view for candidate in ranked]


def _answers(
    table: _Table,
    database: Sequence[DescribedImage],
    queries: Sequence[DescribedImage],
    top: int,
    in_order: bool,
    workers: int,
    calibration: Calibration,
    motion: Motion | None = None,
) -> list[Answer]:
    evidence = _evidence_along_ways(table.score) if in_order else None
    penalty = CONTRADICTED_IN_ORDER if in_order else CONTRADICTED

    def answer(row: int) -> Answer:
        eligible = np.flatnonzero(np.isfinite(table.score[row]))
        ordering = table.score[row] if evidence is None else evidence[row]
        if motion is not None:
            ordering = ordering.copy()
            ordering[eligible[motion.judge(row, eligible) == CONTRADICTS]] -= penalty
        shortlist = eligible[np.argsort(-ordering[eligible], kind="stable")][: max(top, VERIFIED)]
        verified = {
            int(place): compare(queries[row].features, database[place].features) for place in shortlist[:VERIFIED]
        }
        score = {int(place): float(ordering[place]) for place in shortlist}
        if evidence is None:
            score |= {place: score[place] + SUPPORT_WEIGHT * found.support for place, found in verified.items()}
        ranked = sorted(score, key=lambda place: (-score[place], place))
        off = 0.0 if in_order else calibration.doubt([score[place] for place in ranked[:VERIFIED]])
        if not in_order and ranked and verified[ranked[0]].inliers < confidence.MIN_INLIERS:
            off += confidence.FEW_INLIERS_DOUBT
        matches = [_match(table, row, place, score[place] - off, verified.get(place)) for place in ranked[:top]]
        decided = _decide(queries[row], matches, score[ranked[0]] if ranked else 0.0, in_order, calibration)
        return decided if motion is None else _heed(decided, row, motion)

    with ThreadPoolExecutor(workers, thread_name_prefix="compare") as pool:
        return list(pool.map(answer, range(len(queries))))


def _heed(answer: Answer, row: int, motion: Motion) -> Answer:
    """Say so where the best place is one that odometry contradicts, which is then not accepted."""
    if not answer.matches or motion.judge(row, np.array([answer.matches[0].place]))[0] != CONTRADICTS:
        return answer
    if answer.verdict in (Verdict.UNREADABLE, Verdict.NO_FEATURES):
        return answer
    first = replace(answer.matches[0], accepted=False)
    return Answer((first, *answer.matches[1:]), answer.evidence, 0.0, Verdict.ELSEWHERE)


def _accept_streaks(answers: Sequence[Answer], motion: Motion) -> list[Answer]:
    """Accept the answers that end a streak of neighbouring places which odometry expects, each with enough inliers."""

    def expected(row: int, answer: Answer) -> int:
        verdicts = motion.judge(row, np.array([match.place for match in answer.matches], np.int64))
        if not answer.matches or verdicts[0] != AGREES:
            return -1
        first = answer.matches[0].place  # along a way the best place may be a neighbour of the one that is verified
        near = [match for match in answer.matches if abs(match.place - first) <= STREAK_STEP]
        return first if max(match.inliers for match in near) >= STREAK_INLIERS else -1

    lengths = sequence.streaks(np.array([expected(row, answer) for row, answer in enumerate(answers)]), STREAK_STEP)
    return [
        replace(
            answer,
            matches=(replace(answer.matches[0], accepted=True), *answer.matches[1:]),
            probability=max(answer.probability, confidence.ACCEPTED_FROM),
            verdict=Verdict.ACCEPTED,
        )
        if length >= STREAK and answer.verdict is Verdict.UNSURE
        else answer
        for answer, length in zip(answers, lengths, strict=True)
    ]


def _evidence_along_ways(score: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the evidence along the best way per image: (queries, places), NaN where a place may not be asked for."""
    known = np.where(np.isfinite(score), score, np.nan)
    counts = np.isfinite(known).sum(axis=1, keepdims=True)
    middle = np.nansum(known, axis=1, keepdims=True) / np.maximum(counts, 1)
    summed = sequence.along_ways(np.where(np.isfinite(known), known, middle))
    per_image: NDArray[np.float64] = summed / sequence.reach(len(score))[:, None]
    return np.where(np.isfinite(score), per_image, np.nan)


def _match(table: _Table, row: int, place: int, score: float, found: SpatialEvidence | None) -> Match:
    inliers = 0 if found is None else found.inliers
    return Match(place, score, float(table.votes[row, place]), float(table.jeffrey[row, place]), inliers)


def _decide(
    query: DescribedImage, matches: list[Match], evidence: float, in_order: bool, calibration: Calibration
) -> Answer:
    """Accept the first place or none."""
    if not matches:
        return Answer((), evidence, 0.0, Verdict.EMPTY)
    best = matches[0]
    if in_order:
        probability = calibration.probability_along_way(evidence)
    else:
        probability = calibration.probability_single(evidence, best.inliers)
    verdict = Verdict.ACCEPTED
    if query.problem is not None:
        verdict, probability = Verdict.UNREADABLE, 0.0
    elif not in_order and not len(query.descriptors):
        verdict, probability = Verdict.NO_FEATURES, 0.0
    elif not in_order and best.inliers < confidence.MIN_INLIERS:
        verdict = Verdict.FEW_INLIERS
    elif probability < confidence.ACCEPTED_FROM:
        verdict = Verdict.UNSURE
    if verdict is Verdict.ACCEPTED:
        matches[0] = Match(best.place, best.score, best.votes, best.jeffrey, best.inliers, True)
    return Answer(tuple(matches), evidence, probability, verdict)
