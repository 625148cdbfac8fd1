"""Which loops are believed: groups that agree, tested against the ways through all others.

After Latif, Cadena, Neira, "Robust loop closing over time for pose graph SLAM" (IJRR 2013) loops that are near to each
other and agree form a group, and groups are accepted or refused as a whole; what contradicts is found by cycles of
odometry and loops as in Mangelsen et al. (ICRA 2018), along the shortest way through everything accepted.
"""

from collections.abc import Collection, Mapping, Sequence
from math import gamma
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains
from seamark.backend.config import ConsistencyConfig
from seamark.backend.consistency import greedy_clique, pair_chi2
from seamark.backend.graph_types import Constraint
from seamark.backend.ledger import Finding
from seamark.backend.loop_groups import Group, near_pairs
from seamark.backend.step_table import StepTable
from seamark.backend.types import Reason
from seamark.backend.ways import ALL_AXES, LOOP_STEPS, PLANAR_AXES, Way, Ways

# A way that leaves less than this of the volume that odometry alone leaves has something of its own to say.
TELLING_VOLUME: Final = 0.1
# So many findings are compared with their neighbours at once: more would only take memory.
JOINED_AT_ONCE: Final = 200
# A map is taken to be at least so wide, high and deep, in its own units.
LEAST_SIDE: Final = 1.0


class PoseJudge:
    """Groups of findings and the verdicts on them.

    A finding joins the group of the near findings that it agrees with. A group is confirmed when ``min_support`` + 1
    query keyframes take part, when one finding has ``strong_inliers``, or when the evidence of a lone one is
    overwhelming: a wrong loop, drawn anywhere over the map, would pass the same test with a probability below
    ``lone_false_alarm``. A confirmed group is accepted when the cycle along the shortest way through all other accepted
    groups closes. When it does not, the heaviest set of groups without contradiction is sought anew. A group counts by
    its extent, each ``support_keyframes`` of way by the root of the loops in it (neighbours may share one mistake, a
    long way in step is no chance), and by its agreement with odometry. An accepted group that
    one of comparable weight contradicts is left out too, until one outweighs the other by ``contest_ratio``.
    """

    def __init__(self, chains: OdometryChains, config: ConsistencyConfig, planar: bool = False) -> None:
        self._chains, self._config, self._planar = chains, config, planar
        self._findings: list[Finding] = []
        self._tables: dict[tuple[int, int], StepTable] = {}  # sessions -> findings
        self._group_of: list[int] = []
        self._groups: dict[int, Group] = {}
        self._ways = Ways(chains, PLANAR_AXES if planar else ALL_AXES)
        self._agree: dict[tuple[int, int], bool] = {}  # middles of two groups -> whether odometry lets both be

    def enter(self, findings: Sequence[Finding]) -> Mapping[int, Reason]:
        """See :class:`~seamark.backend.ledger.Judge`."""
        before = {number: self._verdict(group) for number, group in self._groups.items()}
        joined = set(self._join_all(findings))
        entered = [self._groups[number] for number in sorted(joined) if number in self._groups]
        for group in entered:
            self._describe(group)
        # What joins an accepted group is accepted with it; a group that is confirmed by now calls for a judgement.
        called = [group for group in entered if not group.accepted and self._confirmed(group)]
        if len(called) == 1 and self._admissible(called[0], self._way(called[0], self._accepted())):
            called[0].accepted = True
        elif called:
            self._choose(self._nearest_groups(called))
        moved = any(before.get(number) != self._verdict(group) for number, group in self._groups.items())
        waiting = [group for group in self._groups.values() if not group.accepted and not self._confirmed(group)]
        self._hear(self._nearest(waiting, entered) if moved else [group for group in entered if group in waiting])
        changed = [g for n, g in self._groups.items() if g in entered or before.get(n) != self._verdict(g)]
        return {member: self._verdict(group) for group in changed for member in group.members}

    def restore(self, finding: Finding) -> None:
        """See :class:`~seamark.backend.ledger.Judge`."""
        group = self._groups[self._join_all([finding])[0]]
        group.accepted = True
        self._describe(group)

    def _verdict(self, group: Group) -> Reason:
        if group.accepted:
            return Reason.ACCEPTED
        return Reason.INCONSISTENT if group.contradicted or group.contested else Reason.UNCONFIRMED

    def _constraint(self, number: int) -> Constraint:
        constraint = self._findings[number].constraint
        assert constraint is not None
        return constraint

    def _join_all(self, findings: Sequence[Finding]) -> list[int]:
        """Put findings into the groups they belong to; return the group's number of each as it joined.

        Which neighbours agree is worked out for many findings in one go.
        """
        numbers, joined = [], []
        near: list[tuple[list[int], NDArray[np.int64]]] = []
        for finding in findings:
            near.append(self._neighbours(finding))
            numbers.append(len(self._findings))
            self._findings.append(finding)
        for first in range(0, len(findings), JOINED_AT_ONCE):
            part = slice(first, first + JOINED_AT_ONCE)
            ones = [
                self._constraint(n) for n, (others, _) in zip(numbers[part], near[part], strict=True) for _ in others
            ]
            loops = [self._constraint(other) for others, _ in near[part] for other in others]
            chi2 = pair_chi2(ones, loops, self._chains)[0] if loops else np.zeros(0)
            agrees = (chi2 <= self._config.pair_chi2).tolist()
            for number, (others, apart) in zip(numbers[part], near[part], strict=True):
                joined.append(self._join(number, others, apart, agrees[: len(others)]))
                agrees = agrees[len(others) :]
        return joined

    def _join(self, number: int, others: list[int], apart: NDArray[np.int64], agrees: Sequence[bool]) -> int:
        """Put a finding into the group that most of its neighbours there agree with, which may join groups."""
        self._group_of.append(number)
        group = self._groups[number] = Group(number, [number])
        votes: dict[int, int] = {}
        for other, agreed in zip(others, agrees, strict=True):
            votes[self._group_of[other]] = votes.get(self._group_of[other], 0) + (1 if agreed else -1)
        for other_group in sorted(k for k, vote in votes.items() if vote > 0):
            group = self._merge(self._groups[other_group], group)
        # Ways need no loop that runs beside another one of its group through which they lead.
        beside = (other for other, steps in zip(others, apart.tolist(), strict=True) if steps < LOOP_STEPS / 2)
        if not any(other in self._ways and self._group_of[other] == group.number for other in beside):
            self._ways.add(number, self._constraint(number))
        return group.number

    def _neighbours(self, finding: Finding) -> tuple[list[int], NDArray[np.int64]]:
        """Return the nearest findings of the same sessions within reach, and how many steps (K,) they are away."""
        table = self._tables.setdefault(finding.sessions, StepTable())
        steps = (self._chains.step(finding.query_id), self._chains.step(finding.match_id))
        numbers, apart = table.near(steps, self._config.support_keyframes)
        table.append(len(self._findings), steps)
        order = np.argsort(apart, kind="stable")[: self._config.compared_loops]
        return numbers[order].tolist(), apart[order]

    def _merge(self, one: Group, other: Group) -> Group:
        """Move all members into the older group and return it."""
        old, new = (one, other) if one.number < other.number else (other, one)
        for member in new.members:
            self._group_of[member] = old.number
        old.members += new.members
        old.accepted |= new.accepted
        del self._groups[new.number]
        return old

    def _describe(self, group: Group) -> None:
        """Say anew who speaks for the group and how much it weighs."""
        ordered = sorted(group.members, key=lambda number: self._findings[number].key)
        group.middle = ordered[len(ordered) // 2]
        group.odometry = self._ways.odometry(self._constraint(group.middle))
        strain = 0.0 if group.odometry is None else group.odometry.chi2 / self._config.gate_chi2
        group.weight = self._extent(ordered) * (1 - 0.5 * min(strain, 1.0))

    def _extent(self, ordered: Sequence[int]) -> float:
        """Return the sum over stretches of the way of the root of the evidence in each."""
        strong = self._config.strong_inliers
        stretches: dict[int, float] = {}
        first = self._chains.step(self._findings[ordered[0]].query_id)
        for number in ordered:
            finding = self._findings[number]
            stretch = (self._chains.step(finding.query_id) - first) // self._config.support_keyframes
            stretches[stretch] = stretches.get(stretch, 0.0) + min(finding.inliers, strong) / strong
        return float(np.sqrt(list(stretches.values())).sum())

    def _nearest_groups(self, centres: Sequence[Group]) -> list[Group]:
        """Return the accepted and the confirmed groups nearest to these, these included, by number."""
        return self._nearest([g for g in self._groups.values() if g.accepted or self._confirmed(g)], centres)

    def _nearest(self, groups: list[Group], centres: Sequence[Group]) -> list[Group]:
        """Return the groups nearest to these, by number."""
        most = max(self._config.compared_loops, len(centres))
        if len(groups) > most:
            keys = np.array([self._findings[group.middle].key for group in groups])
            middles = np.array([self._findings[group.middle].key for group in centres])
            distances = np.abs(keys[:, None] - middles).sum(axis=2).min(axis=1)
            groups = [groups[i] for i in np.argsort(distances, kind="stable")[:most]]
        return sorted(groups, key=lambda group: group.number)

    def _confirmed(self, group: Group) -> bool:
        """Return whether a group speaks with more than one voice, or with one that suffices."""
        queries = {self._findings[number].query_id for number in group.members}
        if len(queries) > self._config.min_support:
            return True
        return any(self._findings[number].inliers >= self._config.strong_inliers for number in group.members)

    def _accepted(self) -> set[int]:
        return {number for number, group in self._groups.items() if group.accepted}

    def _way(self, group: Group, accepted: Collection[int]) -> Way | None:
        """Return the way of a group's middle through the accepted others."""
        return self._ways.test(
            self._constraint(group.middle),
            lambda number: self._group_of[number] != group.number and self._group_of[number] in accepted,
        )

    def _closes(self, way: Way | None) -> bool:
        return way is None or way.chi2 <= self._config.pair_chi2

    def _admissible(self, group: Group, way: Way | None) -> bool:
        """Return whether a group agrees with all accepted ones and with those left out but not refuted."""
        if not self._closes(way):
            return False
        others = [other for other in self._nearest_groups([group]) if other is not group and not other.contradicted]
        return bool(self._agreement([*others, group])[-1].all())

    def _choose(self, groups: list[Group]) -> None:
        """Accept the heaviest set of these groups without contradiction; accepted ones elsewhere stay."""
        numbers = {group.number for group in groups}
        frozen = self._accepted() - numbers
        weights = np.array([group.weight for group in groups])
        clique = greedy_clique(self._agreement(groups), weights, self._config.clique_starts)
        chosen = frozen | {group.number for group, member in zip(groups, clique, strict=True) if member}
        self._drop_contradictory(chosen, numbers)
        for group in sorted(groups, key=lambda group: (-group.weight, group.number)):
            if group.number not in chosen and self._closes(self._way(group, chosen)):
                chosen.add(group.number)
        contested = self._contested(groups, chosen)
        chosen -= contested
        for group in groups:
            group.accepted = group.number in chosen
            group.contested = group.number in contested
            group.contradicted = not group.accepted and not self._closes(self._way(group, chosen))

    def _drop_contradictory(self, chosen: set[int], free: set[int]) -> None:
        """Take groups out of ``chosen`` until all ways close, each time the one that costs least."""
        ways = {number: self._way(self._groups[number], chosen) for number in sorted(chosen & free)}
        failing = {number: way for number, way in ways.items() if way is not None and not self._closes(way)}
        while failing:
            suspects = set(failing)
            for way in failing.values():
                suspects |= {self._group_of[loop] for loop in way.loops} & free
            _, worst = min((self._cost_without(suspect, chosen, failing), suspect) for suspect in sorted(suspects))
            chosen.discard(worst)
            again = {number: self._way(self._groups[number], chosen) for number in sorted(failing) if number != worst}
            failing = {number: way for number, way in again.items() if way is not None and not self._closes(way)}

    def _cost_without(self, suspect: int, chosen: set[int], failing: Mapping[int, Way]) -> float:
        """Return the weight lost without a group, and that of the groups whose ways still do not close."""
        rest = chosen - {suspect}
        still = [n for n in failing if n != suspect and not self._closes(self._way(self._groups[n], rest))]
        return self._groups[suspect].weight + sum(self._groups[n].weight for n in still)

    def _contested(self, groups: list[Group], chosen: set[int]) -> set[int]:
        """Return the chosen groups that one left out contradicts alone and with comparable weight, and the latter."""
        contested = set()
        for group in groups:
            if group.number in chosen:
                continue
            way = self._way(group, chosen)
            against = set() if way is None or self._closes(way) else {self._group_of[loop] for loop in way.loops}
            if len(against) == 1:
                other = self._groups[against.pop()]
                if self._config.contest_ratio * group.weight > other.weight + self._backing(other, chosen):
                    contested |= {other.number, group.number}
        return contested

    def _backing(self, group: Group, chosen: set[int]) -> float:
        """Return the weight of the other groups whose way says the same as the group."""
        way = self._way(group, chosen)
        if way is None or not self._closes(way):
            return 0.0
        telling = group.odometry is None or way.volume < TELLING_VOLUME * group.odometry.volume
        return sum(self._groups[g].weight for g in {self._group_of[n] for n in way.loops}) if telling else 0.0

    def _hear(self, groups: Sequence[Group]) -> None:
        """Accept lone loops whose evidence is overwhelming; say of the others whether they contradict."""
        for group in groups:
            way = self._way(group, self._accepted())
            group.contradicted = not self._closes(way)
            if way is not None and self._chance(way) <= self._config.lone_false_alarm:
                group.accepted = self._admissible(group, way)

    def _chance(self, way: Way) -> float:
        """Return how probable it is that a wrong loop, any pose over the map alike, closes as tight a cycle."""
        sides = self._chains.extent()
        if self._planar:
            everywhere = float(np.prod(np.maximum(sides[:2], LEAST_SIDE))) * 2 * np.pi
        else:
            everywhere = float(np.prod(np.maximum(sides, LEAST_SIDE))) * 8 * np.pi**2
        d = 3 if self._planar else 6
        ball = np.pi ** (d / 2) / gamma(d / 2 + 1) * self._config.pair_chi2 ** (d / 2)
        return min(1.0, ball * way.volume / everywhere)

    def _agreement(self, groups: Sequence[Group]) -> NDArray[np.bool_]:
        """Return which pairs (n, n) of groups odometry lets be; of other sessions it says nothing."""
        agree = np.ones((len(groups), len(groups)), bool)
        middles = [group.middle for group in groups]
        sessions = [self._findings[number].sessions for number in middles]
        pairs = [
            (i, j)
            for i, j in near_pairs([self._findings[number].key for number in middles], self._config.compared_loops)
            if sessions[i] == sessions[j]
        ]
        unknown = [(i, j) for i, j in pairs if (middles[i], middles[j]) not in self._agree]
        if unknown:
            ones, others = ([self._constraint(middles[pair[k]]) for pair in unknown] for k in (0, 1))
            chi2, _ = pair_chi2(ones, others, self._chains)
            for (i, j), value in zip(unknown, chi2.tolist(), strict=True):
                self._agree[middles[i], middles[j]] = value <= self._config.pair_chi2
        for i, j in pairs:
            agree[i, j] = agree[j, i] = self._agree[middles[i], middles[j]]
        return agree
