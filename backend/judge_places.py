"""Which recognised places are believed where no poses are known (mode places)."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from seamark.backend.config import ConsistencyConfig, PlacesConfig
from seamark.backend.consistency import greedy_clique
from seamark.backend.ledger import Finding
from seamark.backend.types import Reason

Flags = NDArray[np.bool_]


class PlaceJudge:
    """Places that move along with the images that see them support each other.

    Neighbouring images that see neighbouring places but do not move along contradict each other; all else agrees. Of
    the findings nearest to a new one the heaviest set in which all agree is sought; in it, findings with many inliers
    or with a supporting neighbour are accepted, others wait. Those outside that an accepted one contradicts are
    inconsistent.
    """

    def __init__(self, config: PlacesConfig, consistency: ConsistencyConfig) -> None:
        self._config, self._consistency = config, consistency
        self._findings: list[Finding] = []
        self._verdicts: list[Reason] = []
        self._groups: dict[tuple[int, int], list[int]] = {}

    def enter(self, findings: Sequence[Finding]) -> Mapping[int, Reason]:
        """See :class:`~seamark.backend.ledger.Judge`."""
        verdicts: dict[int, Reason] = {}
        for finding in findings:
            numbers = self._nearest(self._append(finding, Reason.UNCONFIRMED))
            for number, verdict in zip(numbers, self._judge(numbers), strict=True):
                self._verdicts[number] = verdicts[number] = verdict
        return verdicts

    def restore(self, findings: Sequence[Finding]) -> None:
        """See :class:`~seamark.backend.ledger.Judge`."""
        for finding in findings:
            self._append(finding, Reason.ACCEPTED)

    def _append(self, finding: Finding, verdict: Reason) -> int:
        number = len(self._findings)
        self._findings.append(finding)
        self._verdicts.append(verdict)
        self._groups.setdefault(finding.sessions, []).append(number)
        return number

    def _nearest(self, number: int) -> list[int]:
        """Return the numbers of the findings nearest to this one, itself included, ascending."""
        group = self._groups[self._findings[number].sessions]
        distances = np.abs(np.array([self._findings[i].key for i in group]) - self._findings[number].key).sum(axis=1)
        order = np.argsort(distances, kind="stable")[: self._consistency.compared_loops]
        return sorted({group[i] for i in order} | {number})

    def _judge(self, numbers: list[int]) -> list[Reason]:
        """Return the verdicts on these findings, given all that is known of them."""
        inliers = np.array([self._findings[i].inliers for i in numbers])
        accepted = np.array([self._verdicts[i] == Reason.ACCEPTED for i in numbers])
        agree, support = self._relations(np.array([self._findings[i].key for i in numbers]))
        strong = self._config.strong_inliers
        members = greedy_clique(agree, np.minimum(inliers, strong) / strong, self._consistency.clique_starts)
        supported = (support & members).sum(axis=1) >= self._config.min_support
        # An accepted member stays: its support may lie outside of what is compared here.
        good = members & (accepted | supported | (inliers >= strong))
        contradicted = (~agree & good).any(axis=1)
        return [
            Reason.ACCEPTED if good[k] else Reason.INCONSISTENT if contradicted[k] else Reason.UNCONFIRMED
            for k in range(len(numbers))
        ]

    def _relations(self, keys: NDArray[np.int64]) -> tuple[Flags, Flags]:
        """Return which pairs (n, n) agree and which support each other; a place may be passed in either direction."""
        moved, match_moved = (keys[None, :, k] - keys[:, None, k] for k in (0, 1))
        near = (np.abs(moved) > 0) & (np.abs(moved) <= self._config.window_queries)
        along = np.minimum(np.abs(match_moved - moved), np.abs(match_moved + moved)) <= self._config.slack_images
        same_island = np.abs(match_moved) <= self._config.island_images
        return ~near | along | ~same_island, near & along
