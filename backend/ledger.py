"""All loops that geometry found, and the verdict on each, which later ones may change."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains
from seamark.backend.config import ConsistencyConfig, PlacesConfig
from seamark.backend.consistency import greedy_clique, pair_chi2
from seamark.backend.graph_types import Constraint
from seamark.backend.types import Reason

Key = tuple[int, int]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Finding:
    """A loop that geometry supports: keyframe ids, sessions, inliers and, where poses are known, the constraint."""

    query_id: int
    match_id: int
    query_session: int
    match_session: int
    inliers: int
    constraint: Constraint | None = None

    @property
    def key(self) -> Key:
        """The pair of keyframes, which names the loop."""
        return self.query_id, self.match_id


class Relation(Protocol):
    """What two findings of the same sessions say of each other."""

    strong_inliers: int
    min_support: int

    def relate(self, finding: Finding, others: Sequence[Finding]) -> tuple[Flags, Flags]:
        """Return which others (K,) agree with the finding, and which of these are near enough to support it."""


class PoseRelation:
    """Findings agree where the cycle through both and the odometry closes (pairwise consistency)."""

    def __init__(self, chains: OdometryChains, config: ConsistencyConfig) -> None:
        self._chains, self._config = chains, config
        self.strong_inliers, self.min_support = config.strong_inliers, config.min_support

    def relate(self, finding: Finding, others: Sequence[Finding]) -> tuple[Flags, Flags]:
        """See :class:`Relation`; support comes from neighbours of another query keyframe only."""
        assert finding.constraint is not None
        constraints = [other.constraint for other in others if other.constraint is not None]
        chi2, steps = pair_chi2(finding.constraint, constraints, self._chains)
        agree = chi2 <= self._config.pair_chi2
        near = (steps <= self._config.support_keyframes).all(axis=1) & (steps[:, 0] > 0)
        return agree, agree & near


class PlaceRelation:
    """Places that move along with the images that see them support each other.

    Neighbouring images that see neighbouring places but do not move along contradict each other; all else agrees.
    """

    def __init__(self, config: PlacesConfig) -> None:
        self._config = config
        self.strong_inliers, self.min_support = config.strong_inliers, config.min_support

    def relate(self, finding: Finding, others: Sequence[Finding]) -> tuple[Flags, Flags]:
        """See :class:`Relation`; a place may be passed in either direction."""
        moved = np.array([other.query_id - finding.query_id for other in others])
        match_moved = np.array([other.match_id - finding.match_id for other in others])
        near = (np.abs(moved) > 0) & (np.abs(moved) <= self._config.window_queries)
        along = np.minimum(np.abs(match_moved - moved), np.abs(match_moved + moved)) <= self._config.slack_images
        same_island = np.abs(match_moved) <= self._config.island_images
        return ~near | along | ~same_island, near & along


class LoopLedger:
    """Findings and verdicts.

    A new finding is judged together with the nearest ones of the same two sessions: the heaviest set in which all
    agree is sought; in it, findings with many inliers or with a supporting neighbour are accepted, others wait. Those
    outside that an accepted one contradicts are inconsistent. So a waiting loop is accepted once it is confirmed, and
    an accepted one is withdrawn when more loops speak against it than for it.
    """

    def __init__(self, relation: Relation, compared: int, starts: int) -> None:
        self._relation, self._compared, self._starts = relation, compared, starts
        self._findings: list[Finding] = []
        self._numbers: dict[Key, int] = {}
        self._groups: dict[tuple[int, int], list[int]] = {}
        self._related: dict[Key, tuple[bool, bool]] = {}
        self._verdicts: list[Reason] = []

    def add(self, finding: Finding) -> dict[Key, Reason]:
        """Enter a finding; return the verdicts that are new or changed."""
        number = self._append(finding, Reason.UNCONFIRMED)
        numbers = self._nearest(number, self._groups[finding.query_session, finding.match_session])
        agree, support = self._matrices(numbers)
        before = [self._verdicts[i] for i in numbers]
        after = self._judge(numbers, agree, support)
        changes = {}
        for i, old, new in zip(numbers, before, after, strict=True):
            if old != new or i == number:
                self._verdicts[i] = new
                changes[self._findings[i].key] = new
        return changes

    def restore(self, finding: Finding) -> None:
        """Enter a finding that was accepted in an earlier life, unasked."""
        self._append(finding, Reason.ACCEPTED)

    def finding(self, key: Key) -> Finding:
        """Return the finding of this pair of keyframes."""
        return self._findings[self._numbers[key]]

    def _append(self, finding: Finding, verdict: Reason) -> int:
        number = self._numbers[finding.key] = len(self._findings)
        self._findings.append(finding)
        self._verdicts.append(verdict)
        self._groups.setdefault((finding.query_session, finding.match_session), []).append(number)
        return number

    def _nearest(self, number: int, group: list[int]) -> list[int]:
        """Return the numbers of the findings nearest to this one, itself included, ascending."""
        middle = np.array(self._findings[number].key)
        distances = np.abs(np.array([self._findings[i].key for i in group]) - middle).sum(axis=1)
        order = np.argsort(distances, kind="stable")[: self._compared]
        return sorted({group[i] for i in order} | {number})

    def _matrices(self, numbers: list[int]) -> tuple[Flags, Flags]:
        """Return which pairs (n, n) of these findings agree, and which support each other; each pair is tried once."""
        agree, support = np.eye(len(numbers), dtype=bool), np.zeros((len(numbers), len(numbers)), bool)
        for row, i in enumerate(numbers):
            unknown = [j for j in numbers[row + 1 :] if (i, j) not in self._related]
            if unknown:
                flags = self._relation.relate(self._findings[i], [self._findings[j] for j in unknown])
                for j, agrees, supports in zip(unknown, *flags, strict=True):
                    self._related[i, j] = (bool(agrees), bool(supports))
            for column in range(row + 1, len(numbers)):
                agree[row, column], support[row, column] = self._related[i, numbers[column]]
        return agree | agree.T, support | support.T

    def _judge(self, numbers: list[int], agree: Flags, support: Flags) -> list[Reason]:
        """Return the verdicts on these findings, given all that is known of them."""
        inliers = np.array([self._findings[i].inliers for i in numbers])
        accepted = np.array([self._verdicts[i] == Reason.ACCEPTED for i in numbers])
        strong = self._relation.strong_inliers
        members = greedy_clique(agree, np.minimum(inliers, strong) / strong, self._starts)
        supported = (support & members).sum(axis=1) >= self._relation.min_support
        # An accepted member stays: its support may lie outside of what is compared here.
        good = members & (accepted | supported | (inliers >= strong))
        contradicted = (~agree & good).any(axis=1)
        return [
            Reason.ACCEPTED if good[k] else Reason.INCONSISTENT if contradicted[k] else Reason.UNCONFIRMED
            for k in range(len(numbers))
        ]
