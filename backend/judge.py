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
from seamark.backend.loop_groups import Group, LoopGroups, near_pairs
from seamark.backend.types import Reason
from seamark.backend.ways import ALL_AXES, PLANAR_AXES, Way

# A way that leaves less than this of the volume that odometry alone leaves has something of its own to say.
TELLING_VOLUME: Final = 0.1
# Where odometry has let groups pass of which this many, per accepted one, were refuted, its margin proves nothing ...
REFUTED_SHARE: Final = 0.5
# ... and a group with nothing else to back it, no longer than this many stretches, must lie this close to odometry.
SHORT_STRETCHES: Final = 3
MARGIN_SHARE: Final = 0.12
# A map is taken to be at least so wide, high and deep, in its own units.
LEAST_SIDE: Final = 1.0


class PoseJudge:
    """Groups of findings and the verdicts on them.

    A finding joins the group of the near findings that it agrees with. A group is confirmed when ``min_support`` + 1
    query keyframes take part, when one finding has ``strong_inliers``, or when the evidence of a lone one is
    overwhelming: a wrong loop, drawn anywhere over the map, would pass the same test with a probability below
    ``lone_false_alarm``. A confirmed group is accepted when the cycle along the shortest way through all other accepted
    groups closes. When it does not, the heaviest set of groups without contradiction is sought anew. An accepted group
    that one of comparable weight contradicts is left out too, until one outweighs the other by ``contest_ratio``. Where
    many groups that odometry allowed were refuted, a short one that nothing else backs waits unless it lies close to
    odometry.
    """

    def __init__(self, chains: OdometryChains, config: ConsistencyConfig, planar: bool = False) -> None:
        self._chains, self._config, self._planar = chains, config, planar
        self._groups = LoopGroups(chains, config, PLANAR_AXES if planar else ALL_AXES)
        self._agree: dict[tuple[int, int], bool] = {}  # middles of two groups -> whether odometry lets both be

    def enter(self, findings: Sequence[Finding]) -> Mapping[int, Reason]:
        """See :class:`~seamark.backend.ledger.Judge`."""
        before = {number: self._verdict(group) for number, group in self._groups.by_number.items()}
        entered = self._groups.enter(findings)
        # What joins an accepted group is accepted with it; a group that is confirmed by now calls for a judgement.
        called = [group for group in entered if not group.accepted and self._groups.confirmed(group)]
        if len(called) == 1 and self._admissible(called[0], self._way(called[0], self._groups.accepted())):
            called[0].accepted = not self._leans(called[0])
        elif called:
            self._choose(self._nearest_groups(called))
        moved = any(before.get(number) != self._verdict(group) for number, group in self._groups.by_number.items())
        waiting = [
            group
            for group in self._groups.by_number.values()
            if not group.accepted and not self._groups.confirmed(group)
        ]
        self._hear(
            self._groups.nearest(waiting, entered) if moved else [group for group in entered if group in waiting]
        )
        changed = [g for n, g in self._groups.by_number.items() if g in entered or before.get(n) != self._verdict(g)]
        return {member: self._verdict(group) for group in changed for member in group.members}

    def restore(self, findings: Sequence[Finding]) -> None:
        """See :class:`~seamark.backend.ledger.Judge`."""
        for group in self._groups.enter(findings):
            group.accepted = True

    def lone_chance(self, loop: Constraint) -> float | None:
        """Return how probable it is that a wrong loop would close as tight a cycle as this one does by itself.

        None where its cycle, through odometry and all that is accepted, does not close or is none.
        """
        accepted = self._groups.accepted()
        way = self._groups.ways.test(loop, lambda number: self._groups.group_of[number] in accepted)
        return self._chance(way) if way is not None and self._closes(way) else None

    def _verdict(self, group: Group) -> Reason:
        if group.accepted:
            return Reason.ACCEPTED
        return Reason.INCONSISTENT if group.contradicted or group.contested else Reason.UNCONFIRMED

    def _nearest_groups(self, centres: Sequence[Group]) -> list[Group]:
        """Return the accepted and the confirmed groups nearest to these, these included, by number."""
        return self._groups.nearest(
            [g for g in self._groups.by_number.values() if g.accepted or self._groups.confirmed(g)], centres
        )

    def _way(self, group: Group, accepted: Collection[int]) -> Way | None:
        """Return the way of a group's middle through the accepted others."""
        return self._groups.ways.test(
            self._groups.middle(group),
            lambda number: self._groups.group_of[number] != group.number and self._groups.group_of[number] in accepted,
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
        frozen = self._groups.accepted() - numbers
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
        for group in sorted(groups, key=lambda group: (group.weight, group.number)):
            group.accepted = group.accepted and not self._leans(group)

    def _drop_contradictory(self, chosen: set[int], free: set[int]) -> None:
        """Take groups out of ``chosen`` until all ways close, each time the one that costs least."""
        ways = {number: self._way(self._groups.by_number[number], chosen) for number in sorted(chosen & free)}
        failing = {number: way for number, way in ways.items() if way is not None and not self._closes(way)}
        while failing:
            suspects = set(failing)
            for way in failing.values():
                suspects |= {self._groups.group_of[loop] for loop in way.loops} & free
            _, worst = min((self._cost_without(suspect, chosen, failing), suspect) for suspect in sorted(suspects))
            chosen.discard(worst)
            again = {
                number: self._way(self._groups.by_number[number], chosen)
                for number in sorted(failing)
                if number != worst
            }
            failing = {number: way for number, way in again.items() if way is not None and not self._closes(way)}

    def _cost_without(self, suspect: int, chosen: set[int], failing: Mapping[int, Way]) -> float:
        """Return the weight lost without a group, and that of the groups whose ways still do not close."""
        rest = chosen - {suspect}
        still = [n for n in failing if n != suspect and not self._closes(self._way(self._groups.by_number[n], rest))]
        return self._groups.by_number[suspect].weight + sum(self._groups.by_number[n].weight for n in still)

    def _contested(self, groups: list[Group], chosen: set[int]) -> set[int]:
        """Return the chosen groups that one left out contradicts alone and with comparable weight, and the latter."""
        contested = set()
        for group in groups:
            if group.number in chosen:
                continue
            way = self._way(group, chosen)
            against = set() if way is None or self._closes(way) else {self._groups.group_of[loop] for loop in way.loops}
            if len(against) == 1:
                other = self._groups.by_number[against.pop()]
                if self._config.contest_ratio * group.weight > other.weight + self._backing(other, chosen):
                    contested |= {other.number, group.number}
        return contested

    def _backing(self, group: Group, chosen: set[int]) -> float:
        """Return the weight of the other groups whose way says the same as the group."""
        way = self._way(group, chosen)
        if way is None or not self._closes(way):
            return 0.0
        telling = group.odometry is None or way.volume < TELLING_VOLUME * group.odometry.volume
        return (
            sum(self._groups.by_number[g].weight for g in {self._groups.group_of[n] for n in way.loops})
            if telling
            else 0.0
        )

    def _leans(self, group: Group) -> bool:
        """Return whether a group rests on the margin of odometry alone, where others show this to be no proof."""
        if group.stretches > SHORT_STRETCHES or group.strain(self._config.gate_chi2) <= MARGIN_SHARE:
            return False
        accepted = self._groups.accepted()
        around = self._groups.nearest(list(self._groups.by_number.values()), [group])
        refuted = sum(other.contradicted or other.contested for other in around)
        standing = sum(other.accepted or other is group for other in around)
        return refuted >= REFUTED_SHARE * standing and self._backing(group, accepted) == 0

    def _hear(self, groups: Sequence[Group]) -> None:
        """Accept lone loops whose evidence is overwhelming; say of the others whether they contradict."""
        for group in groups:
            way = self._way(group, self._groups.accepted())
            group.contradicted = not self._closes(way)
            if way is not None and self._chance(way) <= self._config.lone_false_alarm:
                group.accepted = self._admissible(group, way) and not self._leans(group)

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
        sessions = [self._groups.findings[number].sessions for number in middles]
        pairs = [
            (i, j)
            for i, j in near_pairs(
                [self._groups.findings[number].key for number in middles], self._config.compared_loops
            )
            if sessions[i] == sessions[j]
        ]
        unknown = [(i, j) for i, j in pairs if (middles[i], middles[j]) not in self._agree]
        if unknown:
            ones, others = ([self._groups.constraint(middles[pair[k]]) for pair in unknown] for k in (0, 1))
            chi2, _ = pair_chi2(ones, others, self._chains)
            for (i, j), value in zip(unknown, chi2.tolist(), strict=True):
                self._agree[middles[i], middles[j]] = value <= self._config.pair_chi2
        for i, j in pairs:
            agree[i, j] = agree[j, i] = self._agree[middles[i], middles[j]]
        return agree
