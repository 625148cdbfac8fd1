"""Groups of loops that agree: which loop belongs to which, and how much a group says."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains
from seamark.backend.config import ConsistencyConfig
from seamark.backend.consistency import pair_chi2
from seamark.backend.graph_types import Constraint, Key
from seamark.backend.ledger import Finding
from seamark.backend.step_table import StepTable
from seamark.backend.ways import LOOP_STEPS, Way, Ways

# So many findings are compared with their neighbours at once: more would only take memory.
JOINED_AT_ONCE: Final = 200


@dataclass(eq=False)
class Group:
    """Loops near to each other that agree: one observation of one place, however often it was made.

    ``middle`` is the finding that speaks for it, ``odometry`` its way through odometry alone, None where there is none.
    ``stretches``: how many pieces of ``support_keyframes`` of the query's way its loops lie in.
    """

    number: int
    members: list[int] = field(default_factory=list)
    accepted: bool = False
    contradicted: bool = False  # by the way through what is accepted
    contested: bool = False  # by a group of comparable weight, which is left out as well
    middle: int = 0
    weight: float = 0.0
    stretches: int = 1
    odometry: Way | None = None

    def strain(self, chi2: float) -> float:
        """Return which share of a chi squared it takes up against odometry, at most 1."""
        return 0.0 if self.odometry is None else min(self.odometry.chi2 / chi2, 1.0)


class LoopGroups:
    """All findings and the groups that they form; a finding joins the group of the near findings that it agrees with.

    A group weighs by its extent, each ``support_keyframes`` of way by the root of the loops in it (neighbours may share
    one mistake, a long way in step is no chance), and by its agreement with odometry.
    """

    def __init__(self, chains: OdometryChains, config: ConsistencyConfig, axes: tuple[int, ...]) -> None:
        self._chains, self._config = chains, config
        self._tables: dict[tuple[int, int], StepTable] = {}  # sessions -> findings
        self.findings: list[Finding] = []
        self.group_of: list[int] = []
        self.by_number: dict[int, Group] = {}
        self.ways = Ways(chains, axes)

    def constraint(self, number: int) -> Constraint:
        """Return the pose that a finding measures."""
        constraint = self.findings[number].constraint
        assert constraint is not None
        return constraint

    def middle(self, group: Group) -> Constraint:
        """Return the pose that speaks for a group."""
        return self.constraint(group.middle)

    def enter(self, findings: Sequence[Finding]) -> list[Group]:
        """Put findings into the groups they belong to; return these groups, by number, described anew.

        Which neighbours agree is worked out for many findings in one go.
        """
        numbers: list[int] = []
        joined: set[int] = set()
        near: list[tuple[list[int], NDArray[np.int64]]] = []
        for finding in findings:
            near.append(self._neighbours(finding))
            numbers.append(len(self.findings))
            self.findings.append(finding)
        for first in range(0, len(findings), JOINED_AT_ONCE):
            part = slice(first, first + JOINED_AT_ONCE)
            ones = [
                self.constraint(n) for n, (others, _) in zip(numbers[part], near[part], strict=True) for _ in others
            ]
            loops = [self.constraint(other) for others, _ in near[part] for other in others]
            chi2 = pair_chi2(ones, loops, self._chains)[0] if loops else np.zeros(0)
            agrees = (chi2 <= self._config.pair_chi2).tolist()
            for number, (others, apart) in zip(numbers[part], near[part], strict=True):
                joined.add(self._join(number, others, apart, agrees[: len(others)]))
                agrees = agrees[len(others) :]
        entered = [self.by_number[number] for number in sorted(joined) if number in self.by_number]
        for group in entered:
            self._describe(group)
        return entered

    def confirmed(self, group: Group) -> bool:
        """Return whether a group speaks with more than one voice, or with one that suffices."""
        queries = {self.findings[number].query_id for number in group.members}
        if len(queries) > self._config.min_support:
            return True
        return any(self.findings[number].inliers >= self._config.strong_inliers for number in group.members)

    def accepted(self) -> set[int]:
        """Return the numbers of the accepted groups."""
        return {number for number, group in self.by_number.items() if group.accepted}

    def nearest(self, groups: list[Group], centres: Sequence[Group]) -> list[Group]:
        """Return the groups nearest to ``centres``, by number."""
        most = max(self._config.compared_loops, len(centres))
        if len(groups) > most:
            keys = np.array([self.findings[group.middle].key for group in groups])
            middles = np.array([self.findings[group.middle].key for group in centres])
            distances = np.abs(keys[:, None] - middles).sum(axis=2).min(axis=1)
            groups = [groups[i] for i in np.argsort(distances, kind="stable")[:most]]
        return sorted(groups, key=lambda group: group.number)

    def _join(self, number: int, others: list[int], apart: NDArray[np.int64], agrees: Sequence[bool]) -> int:
        """Put a finding into the group that most of its neighbours there agree with, which may join groups."""
        self.group_of.append(number)
        group = self.by_number[number] = Group(number, [number])
        votes: dict[int, int] = {}
        for other, agreed in zip(others, agrees, strict=True):
            votes[self.group_of[other]] = votes.get(self.group_of[other], 0) + (1 if agreed else -1)
        for other_group in sorted(k for k, vote in votes.items() if vote > 0):
            group = self._merge(self.by_number[other_group], group)
        # Ways need no loop that runs beside another one of its group through which they lead.
        beside = (other for other, steps in zip(others, apart.tolist(), strict=True) if steps < LOOP_STEPS / 2)
        if not any(other in self.ways and self.group_of[other] == group.number for other in beside):
            self.ways.add(number, self.constraint(number))
        return group.number

    def _neighbours(self, finding: Finding) -> tuple[list[int], NDArray[np.int64]]:
        """Return the nearest findings of the same sessions within reach, and how many steps (K,) they are away."""
        table = self._tables.setdefault(finding.sessions, StepTable())
        steps = (self._chains.step(finding.query_id), self._chains.step(finding.match_id))
        numbers, apart = table.near(steps, self._config.support_keyframes)
        table.append(len(self.findings), steps)
        order = np.argsort(apart, kind="stable")[: self._config.compared_loops]
        return numbers[order].tolist(), apart[order]

    def _merge(self, one: Group, other: Group) -> Group:
        """Move all members into the older group and return it."""
        old, new = (one, other) if one.number < other.number else (other, one)
        for member in new.members:
            self.group_of[member] = old.number
        old.members += new.members
        old.accepted |= new.accepted
        del self.by_number[new.number]
        return old

    def _describe(self, group: Group) -> None:
        """Say anew who speaks for the group and how much it weighs."""
        ordered = sorted(group.members, key=lambda number: self.findings[number].key)
        group.middle = ordered[len(ordered) // 2]
        group.odometry = self.ways.odometry(self.middle(group))
        stretches = self._evidence_by_stretch(ordered)
        group.stretches = len(stretches)
        group.weight = float(np.sqrt(stretches).sum()) * (1 - 0.5 * group.strain(self._config.gate_chi2))

    def _evidence_by_stretch(self, ordered: Sequence[int]) -> list[float]:
        """Return the evidence in each stretch of the queries' way, a loop with ``strong_inliers`` counting 1."""
        strong = self._config.strong_inliers
        stretches: dict[int, float] = {}
        first = self._chains.step(self.findings[ordered[0]].query_id)
        for number in ordered:
            finding = self.findings[number]
            stretch = (self._chains.step(finding.query_id) - first) // self._config.support_keyframes
            stretches[stretch] = stretches.get(stretch, 0.0) + min(finding.inliers, strong) / strong
        return list(stretches.values())


def near_pairs(keys: Sequence[Key], most: int) -> list[tuple[int, int]]:
    """Return pairs i > j of loops, each with its ``most`` nearest only: odometry says little of those far away."""
    ends = np.array(keys).reshape(-1, 2)
    pairs: list[tuple[int, int]] = []
    for i in range(1, len(ends)):
        nearest = list(range(i))
        if i > most:
            nearest = sorted(np.argsort(np.abs(ends[:i] - ends[i]).sum(axis=1), kind="stable")[:most].tolist())
        pairs += [(i, j) for j in nearest]
    return pairs
